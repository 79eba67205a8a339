//! Sampling of parameters: what a role allows, and the ledger of what was sampled.

pub mod draws;
mod error;
pub mod ledger;

pub use error::Error;
