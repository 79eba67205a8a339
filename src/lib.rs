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

/// The protocols: generated from `proto`, whose comments specify every field. `perturb.v1` is here at the top.
#[allow(missing_docs, clippy::all)]
pub mod proto {
    tonic::include_proto!("perturb.v1");

    /// DeepMind's protocol between agents and environments.
    pub mod dm_env_rpc {
        /// Its first version.
        pub mod v1 {
            tonic::include_proto!("dm_env_rpc.v1");

            /// Its extensions.
            pub mod extensions {
                /// Values by name.
                pub mod properties {
                    tonic::include_proto!("dm_env_rpc.v1.extensions.properties");
                }
            }
        }
    }

    /// Google's messages that dm_env_rpc uses.
    pub mod google {
        /// Errors.
        pub mod rpc {
            tonic::include_proto!("google.rpc");
        }
    }

    /// The encoded descriptors of all protocols, for server reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}
