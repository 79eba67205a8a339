//! `perturb.v1`: batches of environments whose parameters clients choose.
//!
//! - [`service`]: one short method for each call.
//! - [`session`]: the legal order of a session's requests.
//! - [`convert`]: conversion between the protocol and the domain, with all validation; [`policy`]: the same for
//!   policies.
//! - `price`: the price of each request, in steps that count against the token's rate limit.
//! - [`sizes`]: upper bounds of the lengths of requests and replies.

pub mod convert;
mod error;
pub mod fields;
pub mod policy;
mod price;
pub mod service;
pub mod session;
pub mod sizes;

pub use error::Error;
