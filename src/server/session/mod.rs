//! Sessions: each request gets one response, in order. A leased session survives the loss of its stream.

pub mod admission;
pub mod driver;
mod error;
mod exchange;
pub mod handler;
pub mod instrumented;
pub mod lease;
pub mod replay_buffer;

pub use error::Error;
