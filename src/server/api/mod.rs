//! The two gRPC protocols that the server offers.

pub mod dm_env_rpc;
pub mod perturb_v1;
