//! Why something may not be sampled.

use crate::{
    env,
    server::error::{ErrorKind, InvalidValue, RequestError},
};

/// An error of the check of a role, or of the ledger.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The distributions of a snapshot cannot be read.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The request needs a longer line than the ledger accepts.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The token's role does not allow it.
    #[error(
        "a token of the role {role:?} may not draw from {region} of {environment}: {reason}; ask for what it may draw \
         from, or who runs this server for another token"
    )]
    NotAllowed {
        /// The role.
        role: String,
        /// The environment.
        environment: &'static str,
        /// The region that was to be drawn from.
        region: String,
        /// Why not.
        reason: String,
    },
    /// The ledger cannot be written.
    #[error("this server writes down what is drawn, and cannot: {reason}; try again later, or tell who runs it")]
    NoLedger {
        /// Why not.
        reason: String,
    },
}

impl RequestError for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Environment(error) => error.kind(),
            Self::Value(error) => error.kind(),
            Self::NotAllowed { .. } => ErrorKind::Role,
            Self::NoLedger { .. } => ErrorKind::NoLedger,
        }
    }
}
