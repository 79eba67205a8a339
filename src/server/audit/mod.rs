//! Sampling of parameters: what a role allows, and the ledger of what was sampled.

pub mod draws;
pub mod ledger;
