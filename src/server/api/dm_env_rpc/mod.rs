//! `dm_env_rpc.v1`, DeepMind's protocol, for the same environments as `perturb.v1`. The protocol's worlds are single
//! environments with names.
//!
//! - `service`: the gRPC service.
//! - `agent`: the requests of one stream, and their legal order.
//! - `worlds`: the registry of all worlds of the server, by name, and their lifetimes.
//! - `world`: the part of a world that the requests of several streams may change.
//! - `runner`: runs the episodes of a world on the pool.
//! - `settings`: checks and converts the settings of requests.
//! - `specs`: actions and observations with their uids, names, types and bounds.
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
