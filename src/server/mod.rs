//! The server: gRPC in, gRPC out. Each module uses those below it alone:
//!
//! - `startup`: how it begins and how it ends; [`security`]: the files that keep strangers out.
//! - [`metrics`]: what the server says of itself.
//! - [`api`]: the protocols, with all validation.
//! - [`session`]: the transport of a session, and leases.
//! - [`transport`]: messages off the wire and onto it, and the bytes of both.
//! - [`audit`]: what a session draws from, by its token's role, and the ledger that has it.
//! - [`auth`]: tokens, their quotas and roles.
//! - [`net`]: connections, their limits and encryption.
//! - [`shutdown`]: how far the shutdown is; [`error`]: the classes of errors, with their gRPC codes; [`limits`], [`id`].

pub mod api;
pub mod audit;
pub mod auth;
pub mod error;
pub mod id;
pub mod limits;
pub mod metrics;
pub mod net;
pub mod security;
pub mod session;
pub mod shutdown;
mod startup;
pub mod transport;

pub use startup::{Error, listing, run};
