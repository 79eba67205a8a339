//! Reasons for not admitting a session's stream, for ending the stream, or for refusing one of its requests.

use super::lease;
use crate::server::{
    auth,
    error::{ErrorKind, InvalidValue, RequestError},
    id::NoRandomness,
    transport,
};

/// An error of the session layer, or of a layer below it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The token was revoked, its quota is used up, or its rate does not allow the request.
    #[error(transparent)]
    Auth(#[from] auth::Error),
    /// The transport refused a message.
    #[error(transparent)]
    Transport(#[from] transport::Error),
    /// A session cannot be resumed, or another stream has resumed it.
    #[error(transparent)]
    Lease(#[from] lease::Error),
    /// The operating system has no random bits for the name of a lease.
    #[error(transparent)]
    NoRandomness(#[from] NoRandomness),
    /// The server has its maximum number of sessions.
    #[error("all of this server's {limit} sessions are in use; close one, or try again later")]
    SessionsFull {
        /// The maximum number of sessions.
        limit: usize,
    },
    /// The peer has its maximum number of sessions.
    #[error("all of the {limit} sessions that one machine or user may have on this server are in use; close one")]
    PeerFull {
        /// The maximum number of sessions of a peer.
        limit: usize,
    },
    /// The client sent no request for too long, or did not open the session in time.
    #[error(
        "the session was idle for {seconds} s, or was not opened within this time, the limit of this server; start a new \
         one"
    )]
    Idle {
        /// The limit that was exceeded, s.
        seconds: u64,
    },
    /// The server is shutting down.
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
