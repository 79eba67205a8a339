//! perturb: reinforcement-learning environments whose physics can be changed, served over gRPC.
//!
//! The modules in the order in which a request passes through them:
//!
//! - [`server`]: gRPC in, gRPC out; the legal order of a session's calls; all validation.
//! - [`pool`]: batches of environments, stepped by worker threads.
//! - [`env`](mod@env): the trait of an environment, parameters, episodes, trials, receipts, random streams.
//! - [`tasks`]: the environments, one folder each, and their catalogue.
//! - [`scene`]: the content of pictures as data, and [`render`]: the thread that draws it.
//!
//! [`config`] is the server's configuration, [`meters`] has the counters of steps and times, and [`proto`] the protocol.
#![forbid(unsafe_code)]
#![deny(clippy::disallowed_methods)]

pub mod config;
pub mod env;
pub mod meters;
pub mod pool;
mod priority;
pub mod render;
pub mod scene;
pub mod server;
pub mod tasks;
#[cfg(feature = "otel")]
pub mod traces;

pub use perturb_protocol::proto;

/// The version, and the commit that was built, e.g. "0.1.0 (1a2b3c4d5e6f)"; "-dirty" follows a commit whose files were
/// changed.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");
