//! Moves messages between the network and a session, within the memory budget.

pub mod budget;
mod compression;
mod error;
pub mod message_reader;
pub mod precheck;
pub mod raw_body;
pub mod watched_body;

pub use error::Error;
