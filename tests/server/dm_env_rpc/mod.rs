//! The server's other protocol.

pub mod client;
mod protocol;
mod worlds;
