//! Tests of dm_env_rpc, the server's second protocol.

pub mod client;
mod ownership;
mod protocol;
mod worlds;
