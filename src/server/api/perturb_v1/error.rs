//! Why a request of `perturb.v1` is refused.

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

/// A refused request. It changed nothing, except an `act` that failed between its steps.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The session layer refuses the request.
    #[error(transparent)]
    Session(#[from] session::Error),
    /// The token's role does not allow the draw, or the ledger cannot be written.
    #[error(transparent)]
    Audit(#[from] audit::Error),
    /// An environment, a parameter or a snapshot is unknown or not valid.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool is full, or refuses or fails the request.
    #[error(transparent)]
    Pool(#[from] pool::Error),
    /// The picture cannot be drawn.
    #[error(transparent)]
    Render(#[from] render::Error),
    /// A field has a value that it cannot have.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The environment to be drawn has no state.
    #[error("the physics of slot {slot} diverged and left no state to draw; reset it first")]
    NothingToDraw {
        /// The environment's place in the batch.
        slot: usize,
    },
    /// A request other than `open` on a session that is not open.
    #[error("{request} came before open; send open first")]
    NotOpen {
        /// The request.
        request: &'static str,
    },
    /// A second `open`.
    #[error("open came on a session that is open already; use reset, or start another session")]
    AlreadyOpen,
    /// A request that is not allowed in the session's present state.
    #[error("{request} came {when}; {advice}")]
    Order {
        /// The request.
        request: &'static str,
        /// The state in which the request came.
        when: Cow<'static, str>,
        /// The advice to the client.
        advice: &'static str,
    },
}

impl Error {
    /// A [`Value`](Self::Value).
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

/// The error as an in-band response, after which the session stays open.
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
    fn a_picture_of_nothing_names_its_slot() {
        let nothing = Error::NothingToDraw { slot: 7 };
        assert_eq!(nothing.kind().code(), Code::FailedPrecondition);
        assert!(nothing.to_string().contains("slot 7"), "{nothing}");
    }
}
