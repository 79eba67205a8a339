//! Why a request of `dm_env_rpc.v1` is refused.

use crate::{
    env, pool, proto,
    server::{
        audit, auth,
        error::{ErrorKind, InvalidValue, RequestError},
        id::NoRandomness,
        session,
    },
};
use std::borrow::Cow;

/// A refused request, which changed nothing.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The session layer refuses the request.
    #[error(transparent)]
    Session(#[from] session::Error),
    /// The token's role does not allow the draw, or the ledger cannot be written.
    #[error(transparent)]
    Audit(#[from] audit::Error),
    /// An environment or a parameter is unknown or not valid.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool is full or has failed.
    #[error(transparent)]
    Pool(#[from] pool::Error),
    /// A setting, an action or a property has a value that it cannot have.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The system has no random bits for a world's name.
    #[error(transparent)]
    NoRandomness(#[from] NoRandomness),
    /// Nothing has this name.
    #[error("{what} {name} is unknown; {known}")]
    Unknown {
        /// The kind of thing: a world, a setting, an action, …
        what: &'static str,
        /// The unknown name or number.
        name: String,
        /// The names that are known.
        known: String,
    },
    /// A request that needs a joined world came from a stream that has joined none.
    #[error("{request} came from a stream that has joined no world; send join_world first")]
    NotJoined {
        /// The request.
        request: &'static str,
    },
    /// A second `join_world`.
    #[error("join_world came from a stream that has joined {world:?}; leave that world first, or use another stream")]
    AlreadyJoined {
        /// The world that the stream has joined.
        world: String,
    },
    /// The request needs a world without an agent, but the world has one.
    #[error("world {world:?} has an agent; {request} can be done when the agent has left it")]
    Occupied {
        /// The world.
        world: String,
        /// The request.
        request: &'static str,
    },
    /// The world belongs to another stream and is not shared.
    #[error(
        "{request} came from a stream that has neither made world {world:?} nor is its agent; join it first, or have it \
         made with the setting shared"
    )]
    NotYours {
        /// The world.
        world: String,
        /// The request.
        request: &'static str,
    },
    /// The name that was asked for is another world's.
    #[error("a world {world:?} is there already; ask for another name, or for none")]
    Taken {
        /// The name.
        world: String,
    },
    /// A property does not allow this.
    #[error("property {key:?} cannot be {access}; list_property tells what each property allows")]
    Forbidden {
        /// The property.
        key: String,
        /// The access that was requested, as a participle.
        access: &'static str,
    },
    /// An extension that this server does not have.
    #[error("extension {name:?} is unknown; this server has {known}")]
    UnknownExtension {
        /// The type of the message.
        name: String,
        /// The extension that this server has.
        known: &'static str,
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
            Self::Value(error) => error.kind(),
            Self::NoRandomness(error) => error.kind(),
            Self::Unknown { .. } => ErrorKind::UnknownName,
            Self::NotJoined { .. } => ErrorKind::NotJoined,
            Self::AlreadyJoined { .. } => ErrorKind::AlreadyJoined,
            Self::Occupied { .. } => ErrorKind::Occupied,
            Self::NotYours { .. } => ErrorKind::NotYours,
            Self::Taken { .. } => ErrorKind::NameTaken,
            Self::Forbidden { .. } => ErrorKind::ForbiddenProperty,
            Self::UnknownExtension { .. } => ErrorKind::UnknownExtension,
        }
    }
}

impl From<auth::Error> for Error {
    fn from(error: auth::Error) -> Self {
        Self::Session(error.into())
    }
}

/// The error as an in-band response, after which the stream stays open.
impl From<Error> for proto::google::rpc::Status {
    fn from(error: Error) -> Self {
        Self { code: error.kind().code() as i32, message: error.to_string(), details: Vec::new() }
    }
}
