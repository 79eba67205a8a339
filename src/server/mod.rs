//! The server: everything between a gRPC request and its reply. Each module uses only modules further down this list:
//!
//! - [`embedded`]: a server inside a client's process, without a network.
//! - `startup`: starts the server and shuts it down; [`security`]: loads tokens, TLS settings and the ledger from
//!   files.
//! - [`metrics`]: the page that Prometheus scrapes.
//! - [`api`]: the two protocols; all validation of requests.
//! - [`session`]: runs sessions of either protocol, and manages the leases by which a session survives the loss of its
//!   connection.
//! - [`transport`]: reads messages from the network and sends replies, within a memory budget.
//! - [`audit`]: checks from which distributions a token may draw, and records all draws in the ledger.
//! - [`auth`]: tokens, with their quotas, rate limits and roles.
//! - [`net`]: connections, with their limits and their encryption.
//! - [`shutdown`]: the phases of a shutdown; [`error`]: the classes of errors, with their gRPC codes; [`limits`]: size
//!   limits of requests; [`id`]: random names.

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
