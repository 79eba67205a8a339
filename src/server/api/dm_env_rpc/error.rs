//! Reasons for refusing a request of `dm_env_rpc.v1`.

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

/// Why a request was refused. A refused request changes nothing.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The session layer refused the request.
    #[error(transparent)]
    Session(#[from] session::Error),
    /// The token's role does not allow the draw, or the ledger cannot record it.
    #[error(transparent)]
    Audit(#[from] audit::Error),
    /// An environment or a parameter is unknown or invalid.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool has no room for the environment, or failed.
    #[error(transparent)]
    Pool(#[from] pool::Error),
    /// A setting, an action or a property has a value that is not allowed.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The operating system has no random bits for a world's name.
    #[error(transparent)]
    NoRandomness(#[from] NoRandomness),
    /// The name of a world, a setting, an observation or another thing is unknown.
    #[error("{what} {name} is unknown; {known}")]
    Unknown {
        /// The kind of thing: a world, a setting, an action, …
        what: &'static str,
        /// The unknown name or number.
        name: String,
        /// The known names, or how to find them, as a part of a sentence.
        known: String,
    },
    /// The request needs a joined world, but its stream has joined none.
    #[error("{request} came from a stream that has joined no world; send join_world first")]
    NotJoined {
        /// The name of the request.
        request: &'static str,
    },
    /// The stream has already joined a world.
    #[error("join_world came from a stream that has joined {world:?}; leave that world first, or use another stream")]
    AlreadyJoined {
        /// The name of the joined world.
        world: String,
    },
    /// The request needs a world without an agent, but the world has one.
    #[error("world {world:?} has an agent; send {request} after the agent has left the world")]
    Occupied {
        /// The name of the world.
        world: String,
        /// The name of the request.
        request: &'static str,
    },
    /// The world belongs to another stream, and it is not shared.
    #[error(
        "{request} came from a stream that is neither the maker nor the agent of world {world:?}; join it first, or \
         create it with the setting shared"
    )]
    NotYours {
        /// The name of the world.
        world: String,
        /// The name of the request.
        request: &'static str,
    },
    /// The requested name already belongs to another world.
    #[error("there already is a world {world:?}; choose another name, or none for a random name")]
    Taken {
        /// The requested name.
        world: String,
    },
    /// The property does not allow this access, e.g. a write.
    #[error("property {key:?} cannot be {access}; list_property says how each property may be accessed")]
    Forbidden {
        /// The key of the property.
        key: String,
        /// The requested access, as a participle, e.g. "written".
        access: &'static str,
    },
    /// The request uses a protocol extension that this server does not support.
    #[error("extension {name:?} is unknown; this server has {known}")]
    UnknownExtension {
        /// The type of the extension's message.
        name: String,
        /// The extension that this server supports.
        known: &'static str,
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

/// Converts the error to an in-band response. The stream stays open after it.
impl From<Error> for proto::google::rpc::Status {
    fn from(error: Error) -> Self {
        Self { code: error.kind().code() as i32, message: error.to_string(), details: Vec::new() }
    }
}
