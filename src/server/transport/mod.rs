//! Messages between the wire and a session, and the memory that they take.

pub mod budget;
pub mod message_reader;
pub mod precheck;
pub mod watched_body;
