//! The contract between perturb's servers and their clients, which both sides take from here.
#![forbid(unsafe_code)]

/// The protocols: generated from `proto`, whose comments specify every field. `perturb.v1` is here at the top.
#[allow(missing_docs, clippy::all)]
pub mod proto {
    tonic::include_proto!("perturb.v1");

    /// DeepMind's protocol between agents and environments.
    pub mod dm_env_rpc {
        /// Its first version.
        pub mod v1 {
            tonic::include_proto!("dm_env_rpc.v1");

            /// Its extensions.
            pub mod extensions {
                /// Values by name.
                pub mod properties {
                    tonic::include_proto!("dm_env_rpc.v1.extensions.properties");
                }
            }
        }
    }

    /// Google's messages that dm_env_rpc uses.
    pub mod google {
        /// Errors.
        pub mod rpc {
            tonic::include_proto!("google.rpc");
        }
    }

    /// The encoded descriptors of all protocols, for server reflection.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}
