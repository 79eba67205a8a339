//! Reasons for refusing a draw of parameters.

use crate::{
    env,
    server::error::{ErrorKind, InvalidValue, RequestError},
};

/// A draw is not allowed, or the ledger cannot record it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The distributions in a snapshot cannot be read.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The request would need a longer line than the ledger accepts.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The token's role does not allow the draw.
    #[error(
        "a token of the role {role:?} may not draw from {region} of {environment}: {reason}; request a region \
         that it may draw from, or ask the operator of this server for another token"
    )]
    NotAllowed {
        /// The name of the role.
        role: String,
        /// The name of the environment.
        environment: &'static str,
        /// The region of the parameter space from which the draw was requested.
        region: String,
        /// The reason, as a part of a sentence.
        reason: String,
    },
    /// The ledger cannot be written.
    #[error(
        "this server must record each draw in its ledger, and cannot: {reason}; try again later, or tell its operator"
    )]
    NoLedger {
        /// The cause.
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
