//! perturb's learner: trains policies over environment servers and tests whether they still work when the physics
//! changes.
#![forbid(unsafe_code)]

pub mod algorithm;
pub mod checkpoint;
pub mod cli;
pub mod client;
pub mod config;
pub mod error;
pub mod evaluation;
pub mod experiment;
#[cfg(test)]
mod fixture;
pub mod interrupt;
pub mod logging;
pub mod loss;
pub mod policy;
pub mod random;
pub mod rollout;
mod run_directory;
pub mod training;
pub mod video;

/// The version, and the commit that was built, e.g. "0.1.0 (1a2b3c4d5e6f)"; "-dirty" follows a commit whose files were
/// changed.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");

pub use perturb_protocol::proto;
