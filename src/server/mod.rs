//! The server, from gRPC requests to gRPC replies. Each module uses only those below it:
//!
//! - [`embedded`]: a server inside of a client's process, without a transport.
//! - `startup`: startup and shutdown; [`security`]: the files of tokens, TLS and the ledger.
//! - [`metrics`]: the page that Prometheus scrapes.
//! - [`api`]: the protocols, with all validation.
//! - [`session`]: the transport of a session, and leases.
//! - [`transport`]: messages off the wire and onto it, and the memory for both.
//! - [`audit`]: the check of a session's draws against its token's role, and the ledger of draws.
//! - [`auth`]: tokens, their quotas and roles.
//! - [`net`]: connections, their limits and encryption.
//! - [`shutdown`]: the phases of a shutdown; [`error`]: the classes of errors, with their gRPC codes; [`limits`], [`id`].

pub mod api;
pub mod audit;
pub mod auth;
pub mod embedded;
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
