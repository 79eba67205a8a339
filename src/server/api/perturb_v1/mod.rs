//! `perturb.v1`: batches of environments whose parameters clients choose.
//!
//! - [`service`]: one short method for each call.
//! - [`session`]: the legal order of a session's requests.
//! - [`convert`]: the protocol to the domain and back, with all validation; [`policy`]: that of policies.
//! - `price`: what requests cost a token's rate.
//! - [`sizes`]: how many bytes requests and replies have.

pub mod convert;
mod error;
pub mod fields;
pub mod policy;
mod price;
pub mod service;
pub mod session;
pub mod sizes;

pub use error::Error;
