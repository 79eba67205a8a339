//! Reasons for refusing a request of `perturb.v1`.

use crate::{
    env, pool, proto, render,
    server::{
        audit, auth,
        error::{ErrorKind, InvalidValue, RequestError},
        id::NoRandomness,
        session::{self, lease},
        transport,
    },
};
use std::borrow::Cow;

/// Why a request was refused. A refused request changes nothing, except an `act` that fails between two of its steps.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The session layer refused the request.
    #[error(transparent)]
    Session(#[from] session::Error),
    /// The token's role does not allow the draw, or the ledger cannot be written.
    #[error(transparent)]
    Audit(#[from] audit::Error),
    /// An environment, a parameter or a snapshot is unknown or invalid.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool has no room for the environments, refused the request, or failed.
    #[error(transparent)]
    Pool(#[from] pool::Error),
    /// The picture cannot be drawn.
    #[error(transparent)]
    Render(#[from] render::Error),
    /// A field has a value that is not allowed.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The environment cannot be drawn, because its physics diverged.
    #[error("the physics of slot {slot} diverged and left no state to draw; reset it first")]
    NothingToDraw {
        /// The environment's slot in the batch.
        slot: usize,
    },
    /// The session is not open yet, and the request is not `open`.
    #[error("{request} came before open; send open first")]
    NotOpen {
        /// The name of the request.
        request: &'static str,
    },
    /// The request is `open`, but the session is already open.
    #[error("open came on a session that is open already; use reset, or start another session")]
    AlreadyOpen,
    /// The request is not allowed in the present state of the session.
    #[error("{request} came {when}; {advice}")]
    Order {
        /// The name of the request.
        request: &'static str,
        /// The state of the session, as a part of a sentence.
        when: Cow<'static, str>,
        /// The remedy for the client, as a part of a sentence.
        advice: &'static str,
    },
}

impl Error {
    /// Makes an [`Error::Value`].
    pub fn value(field: impl Into<Cow<'static, str>>, got: impl ToString, expected: impl ToString) -> Self {
        InvalidValue::new(field, got, expected).into()
    }
}

impl RequestError for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Session(error) => error.kind(),
            Self::Audit(error) => error.kind(),
            Self::Environment(error) => error.kind(),
            Self::Pool(error) => error.kind(),
            Self::Render(error) => error.kind(),
            Self::Value(error) => error.kind(),
            Self::NothingToDraw { .. } => ErrorKind::NothingToDraw,
            Self::NotOpen { .. } => ErrorKind::NotOpen,
            Self::AlreadyOpen => ErrorKind::AlreadyOpen,
            Self::Order { .. } => ErrorKind::WrongOrder,
        }
    }
}

impl From<auth::Error> for Error {
    fn from(error: auth::Error) -> Self {
        Self::Session(error.into())
    }
}

impl From<transport::Error> for Error {
    fn from(error: transport::Error) -> Self {
        Self::Session(error.into())
    }
}

impl From<lease::Error> for Error {
    fn from(error: lease::Error) -> Self {
        Self::Session(error.into())
    }
}

impl From<NoRandomness> for Error {
    fn from(error: NoRandomness) -> Self {
        Self::Session(error.into())
    }
}

/// Converts the error to an in-band response. The session stays open after it.
impl From<Error> for proto::Error {
    fn from(error: Error) -> Self {
        Self { code: error.kind().code() as i32, message: error.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::Code;

    #[test]
    fn error_names_the_slot_that_cannot_be_drawn() {
        let nothing = Error::NothingToDraw { slot: 7 };
        assert_eq!(nothing.kind().code(), Code::FailedPrecondition);
        assert!(nothing.to_string().contains("slot 7"), "{nothing}");
    }
}
