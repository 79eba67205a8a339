//! The server's other protocol.

pub mod client;
mod ownership;
mod protocol;
mod worlds;
