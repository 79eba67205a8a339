//! Messages between the wire and a session, and the memory that they take.

pub mod budget;
mod compression;
mod error;
pub mod message_reader;
pub mod precheck;
pub mod raw_body;
pub mod watched_body;

pub use error::Error;
