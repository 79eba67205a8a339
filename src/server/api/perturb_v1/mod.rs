//! `perturb.v1`, the project's own protocol: batches of environments whose parameters the client chooses.
//!
//! - [`service`]: the gRPC service.
//! - [`session`]: the requests of one session, and their legal order.
//! - [`convert`]: checks and converts the contents of requests and replies; [`policy`]: the same for policies.
//! - `price`: the price of each request, in steps, for the rate limits of tokens.
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
