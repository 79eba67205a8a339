//! Reasons for refusing a message.

use crate::server::{
    auth,
    error::{ErrorKind, InvalidValue, RequestError},
};

/// A message is too large, incomplete or malformed, or there is no memory for it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The token's quota of bytes in flight is used up.
    #[error(transparent)]
    Auth(#[from] auth::Error),
    /// A field has too many entries, or cannot be decoded.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The budget of bytes in flight is used up.
    #[error(
        "this needs {wanted} bytes, but {used} of the server's {limit} bytes for requests and replies are in use; ask for \
         less at a time, read the replies that wait, or try again later"
    )]
    MemoryFull {
        /// The bytes that were requested.
        wanted: usize,
        /// The bytes that were reserved already.
        used: usize,
        /// The limit of the budget, bytes.
        limit: usize,
    },
    /// The rest of a message did not arrive within the timeout.
    #[error(
        "a message is incomplete: no byte arrived for {seconds} s, or it arrived at less than {rate} bytes per second; \
         send each message without pauses"
    )]
    Unfinished {
        /// The maximum pause within a message, s.
        seconds: u64,
        /// The minimum average rate of a message, bytes per second.
        rate: usize,
    },
    /// A compressed message has more bytes, when decompressed, than the limit that applies to its stream at this
    /// moment.
    #[error(
        "a compressed message has more than {limit} bytes when it is decompressed, which is the limit of this stream \
         at present"
    )]
    DecompressedTooLarge {
        /// The maximum length after decompression, bytes.
        limit: usize,
    },
    /// A message is longer than the limit that applies to its stream at this moment.
    #[error("a message has {got} bytes; the limit of this stream is {limit} bytes at present")]
    TooLarge {
        /// The length of the message, bytes.
        got: usize,
        /// The maximum length, bytes.
        limit: usize,
    },
}

impl RequestError for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Auth(error) => error.kind(),
            Self::Value(error) => error.kind(),
            Self::MemoryFull { .. } => ErrorKind::MemoryFull,
            Self::Unfinished { .. } => ErrorKind::UnfinishedMessage,
            Self::DecompressedTooLarge { .. } | Self::TooLarge { .. } => ErrorKind::TooLarge,
        }
    }
}
