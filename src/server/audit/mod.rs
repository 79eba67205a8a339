//! The audit of draws: checks them against the token's role, and records them in the ledger.

pub mod draws;
mod error;
pub mod ledger;

pub use error::Error;
