//! The learner of perturb. It trains policies in environments on simulation servers, and tests whether they still work
//! when the physics changes.
#![forbid(unsafe_code)]

pub mod algorithm;
pub mod cell;
pub mod checkpoint;
pub mod client;
pub mod error;
pub mod evaluation;
pub mod logging;
pub mod measure;
pub mod policy;
pub mod rollout;
pub mod training;

pub use perturb_protocol::proto;
