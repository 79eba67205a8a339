//! `dm_env_rpc.v1`: the same environments for DeepMind's agents. A world is one environment.
//!
//! - `service`: the stream.
//! - `agent`: the legal order of a stream's requests.
//! - `worlds`: all worlds of the server, by name; how long each lives.
//! - `world`: what requests of any stream may change about a world.
//! - `runner`: a world's episodes, on the pool.
//! - `settings`: conversion of settings to the domain, with the checks of `perturb.v1`.
//! - `specs`: actions and observations, their uids, names and bounds.
//! - `tensors`: checks of a tensor's type, shape and bounds.
//! - `properties`: values that clients read and write by name.

mod agent;
mod error;
mod fields;
mod properties;
mod runner;
pub mod service;
mod settings;
mod specs;
mod tensors;
mod world;
mod worlds;

pub use error::Error;
