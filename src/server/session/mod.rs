//! Sessions: one response for each request, in order, and leases that outlive a stream.

pub mod admission;
pub mod driver;
mod error;
mod exchange;
pub mod handler;
pub mod instrumented;
pub mod lease;
pub mod replay_buffer;

pub use error::Error;
