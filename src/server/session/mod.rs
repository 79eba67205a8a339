//! Sessions: one response for each request, in order, and leases that outlive a stream.

pub mod driver;
mod error;
pub mod handler;
pub mod instrumented;
pub mod lease;
pub mod replay_buffer;

pub use error::Error;
