//! The audit of draws: the check of a token's role, and the ledger.

pub mod draws;
mod error;
pub mod ledger;

pub use error::Error;
