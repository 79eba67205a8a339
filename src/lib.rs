//! perturb: reinforcement-learning environments whose physics can be changed, served over gRPC.
//!
//! The modules in the order in which a request passes through them:
//!
//! - [`server`]: gRPC in, gRPC out; the legal order of a session's calls; all validation.
//! - [`pool`]: batches of environments, stepped by worker threads.
//! - [`env`](mod@env): the trait of an environment, episodes, trials, receipts, random streams.
//! - [`render`]: pictures of environments, drawn by a thread of their own.
//! - [`physics`]: parameters, their bounds, and the distributions of the versions D, R and E.
//! - [`classic`]: CartPole, MountainCar, Acrobot, Pendulum.
//! - [`locomotion`]: Hopper and HalfCheetah on MuJoCo (feature `mujoco`).
//!
//! [`config`] is the server's configuration and [`proto`] the generated protocol.
#![forbid(unsafe_code)]
#![deny(clippy::disallowed_methods)]

pub mod classic;
pub mod config;
pub mod env;
#[cfg(feature = "mujoco")]
pub mod locomotion;
pub mod physics;
pub mod pool;
pub mod render;
pub mod server;

/// The protocol: generated from `proto/perturb/v1/perturb.proto`, whose comments specify every field.
#[allow(missing_docs, clippy::all)]
pub mod proto {
    tonic::include_proto!("perturb.v1");

    /// The encoded descriptors, for server reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/perturb.bin"));
}
