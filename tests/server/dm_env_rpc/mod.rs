//! The server's other protocol.

mod client;
mod protocol;
mod worlds;
