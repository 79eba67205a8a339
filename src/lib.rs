//! perturb: reinforcement-learning environments whose physics can be changed, served over gRPC.
//!
//! The modules, in the order in which a request passes through them:
//!
//! - [`server`]: the gRPC server: sessions, the legal order of their requests, all validation.
//! - [`pool`]: batches of environments, which worker threads step.
//! - [`env`](mod@env): the trait of an environment; parameters, episodes, trials, receipts, random streams.
//! - [`tasks`]: the environments, each in a folder of its own, and their catalogue.
//! - [`scene`]: the content of pictures as data; [`render`]: the thread that draws them.
//!
//! Besides: [`config`] is the server's configuration, [`meters`] contains counters of steps and times, and [`proto`]
//! the messages of the protocol.
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

/// The program's version and the commit of its source, e.g. "0.1.0 (1a2b3c4d5e6f)". "-dirty" is appended to the commit
/// if files were changed after it.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("PERTURB_COMMIT"), ")");
