//! The contract between perturb's servers and their clients. Both sides use this crate.
//!
//! - [`proto`]: the messages.
//! - [`Version`], [`Distribution`], [`Address`], [`limits`]: values that servers and clients share.
//! - [`names`]: the accepted spellings of names.
//! - [`catalogue`]: the environments and limits as JSON.
//! - [`Connection`] and [`Stream`]: a client's side of a session. Each type of request has its type of reply.
//! - [`AdaptiveSpin`]: low-latency waiting for the other side.
//! - [`credentials`]: a client's token and certificate, and the certificates that it trusts.
//! - [`EndedEpisode`]: the result of an episode.
//! - [`player`]: conversions between protocol messages and the policy types of [`perturb_policy`].
//! - [`PrivateServer`]: a server that belongs to one client program.
#![forbid(unsafe_code)]

mod adaptive_spin;
mod address;
pub mod catalogue;
mod connection;
pub mod credentials;
mod distribution;
pub mod disturbance;
mod encryption;
mod ended;
mod error;
mod escape;
pub mod ledger;
pub mod limits;
pub mod names;
pub mod player;
mod private_server;
mod process_limit;
pub mod region;
mod reply;
mod snapshot_parts;
mod stream;
mod version;

pub use adaptive_spin::AdaptiveSpin;
pub use address::{Address, AddressError};
pub use connection::{Connection, ResolvedAddresses, Timeouts, connect, connect_any, resolve};
pub use distribution::{Distribution, DistributionError, Interval, decimal_comma};
pub use ended::EndedEpisode;
pub use error::{ClientError, REPLY_TIMEOUT};
pub use escape::{escape_environment, escape_lines};
pub use private_server::PrivateServer;
pub use process_limit::spawn_failure;
pub use reply::{Malformed, check_observations, check_step};
pub use snapshot_parts::snapshot_parts;
pub use stream::{Stream, TypedRequest};
pub use version::{UnknownVersion, Version};

/// The messages and clients of all protocols, generated from the .proto files, whose comments specify every field. The
/// types of `perturb.v1` are at the top level of this module.
///
/// Run `make generate` after editing a .proto file.
#[allow(missing_docs, clippy::all)]
pub mod proto {
    include!("generated/perturb.v1.rs");

    /// DeepMind's protocol between agents and environments.
    pub mod dm_env_rpc {
        /// Version 1 of the protocol.
        pub mod v1 {
            include!("generated/dm_env_rpc.v1.rs");

            /// Extensions of the protocol.
            pub mod extensions {
                /// Values by name.
                pub mod properties {
                    include!("generated/dm_env_rpc.v1.extensions.properties.rs");
                }
            }
        }
    }

    /// The messages of Google's API that dm_env_rpc uses.
    pub mod google {
        /// The error message `google.rpc.Status`.
        pub mod rpc {
            include!("generated/google.rpc.rs");
        }
    }

    /// The encoded descriptors of all protocols, for server reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!("generated/descriptors.bin");
}
