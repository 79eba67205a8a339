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
//! [`config`] is the server's configuration and [`proto`] the protocol.
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

pub use perturb_protocol::proto;

/// The version, and the commit that was built, e.g. "0.1.0 (1a2b3c4d5e6f)"; "-dirty" follows a commit whose files were
/// changed.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");
