//! The contract between perturb's servers and their clients, which both sides take from here.
//!
//! - [`proto`]: the messages.
//! - [`Version`], [`Distribution`], [`Address`], [`limits`]: what both sides mean by them.
//! - [`names`]: how people may spell names.
//! - [`catalogue`]: the environments and limits as JSON.
//! - [`Connection`] and [`Stream`]: a client's side of a session, one typed reply for each request.
//! - [`Awake`]: how both sides wait for each other.
//! - [`credentials`]: what a client shows, and whom it trusts.
//! - [`EndedEpisode`]: what came of an episode.
//! - [`player`]: a policy that plays, between its messages and [`perturb_policy`].
//! - [`PrivateServer`]: a server of a program's own.
#![forbid(unsafe_code)]

mod address;
mod awake;
pub mod catalogue;
mod connection;
pub mod credentials;
mod distribution;
mod encryption;
mod ended;
mod error;
pub mod ledger;
pub mod limits;
pub mod names;
pub mod player;
mod private_server;
pub mod region;
mod stream;
mod version;

pub use address::{Address, AddressError};
pub use awake::Awake;
pub use connection::{Connection, Machines, Patience, first_of, machines};
pub use distribution::{Distribution, DistributionError, Interval};
pub use ended::EndedEpisode;
pub use error::{ClientError, REPLY_LIMIT};
pub use private_server::PrivateServer;
pub use stream::{Ask, Stream};
pub use version::{UnknownVersion, Version};

/// The protocols: generated from `proto`, whose comments specify every field. `perturb.v1` is here at the top.
///
/// After an edit of a .proto file run `make generate`.
#[allow(missing_docs, clippy::all)]
pub mod proto {
    include!("generated/perturb.v1.rs");

    /// DeepMind's protocol between agents and environments.
    pub mod dm_env_rpc {
        /// Its first version.
        pub mod v1 {
            include!("generated/dm_env_rpc.v1.rs");

            /// Its extensions.
            pub mod extensions {
                /// Values by name.
                pub mod properties {
                    include!("generated/dm_env_rpc.v1.extensions.properties.rs");
                }
            }
        }
    }

    /// Google's messages that dm_env_rpc uses.
    pub mod google {
        /// Errors.
        pub mod rpc {
            include!("generated/google.rpc.rs");
        }
    }

    /// The encoded descriptors of all protocols, for server reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!("generated/descriptors.bin");
}
