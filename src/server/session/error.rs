//! Why a stream is not admitted, or ends.

use super::lease;
use crate::server::{
    auth,
    error::{ErrorKind, InvalidValue, RequestError},
    id::NoRandomness,
    transport,
};

/// An error of a session's transport: the session's own, or one of the layers below.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The token was revoked, is at its quota, or steps too fast.
    #[error(transparent)]
    Auth(#[from] auth::Error),
    /// The transport refuses a message.
    #[error(transparent)]
    Transport(#[from] transport::Error),
    /// A session cannot be resumed, or another stream has resumed it.
    #[error(transparent)]
    Lease(#[from] lease::Error),
    /// The system has no random bits for the name of a lease.
    #[error(transparent)]
    NoRandomness(#[from] NoRandomness),
    /// The server is full of sessions.
    #[error("all of this server's {limit} sessions are in use; close one, or try again later")]
    SessionsFull {
        /// The maximum number of sessions.
        limit: usize,
    },
    /// A peer has as many sessions as it may have.
    #[error("all of the {limit} sessions that one machine or user may have here are in use; close one")]
    PeerFull {
        /// The maximum number of sessions of a peer.
        limit: usize,
    },
    /// The session sent nothing for too long.
    #[error(
        "the session was idle for {seconds} s, or was not opened within this time, the limit of this server; start a new \
         one"
    )]
    Idle {
        /// The limit.
        seconds: u64,
    },
    /// The server takes no new work.
    #[error("this server is shutting down; use another, or try again later")]
    Draining,
}

impl From<InvalidValue> for Error {
    fn from(error: InvalidValue) -> Self {
        Self::Transport(error.into())
    }
}

impl RequestError for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Auth(error) => error.kind(),
            Self::Transport(error) => error.kind(),
            Self::Lease(error) => error.kind(),
            Self::NoRandomness(error) => error.kind(),
            Self::SessionsFull { .. } => ErrorKind::SessionsFull,
            Self::PeerFull { .. } => ErrorKind::PeerQuota,
            Self::Idle { .. } => ErrorKind::Idle,
            Self::Draining => ErrorKind::Draining,
        }
    }
}
