//! The protocols that the server speaks.

pub mod dm_env_rpc;
pub mod perturb_v1;
