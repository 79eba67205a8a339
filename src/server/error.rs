//! The classes of errors that clients receive. Each class has a gRPC code, a word for metrics and logs, and a counter.
//! Each layer has its own error enum and maps its variants to classes with [`RequestError`]. Only this module maps
//! classes to gRPC codes.

use crate::{env, pool, render};
use std::{
    borrow::Cow,
    error::Error,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};
use tonic::{Code, Status};

/// An error that the server returns to a client, as the answer to a request or as the end of a call.
pub trait RequestError: Error {
    /// The error's class.
    fn kind(&self) -> ErrorKind;
}

/// Returns the gRPC status that ends a call or stream with this error's code and message.
pub fn status(error: &impl RequestError) -> Status {
    Status::new(error.kind().code(), error.to_string())
}

/// A field of a request has a value that is not allowed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{field} is {got}; expected {expected}")]
pub struct InvalidValue {
    /// The path of the field in the request; in dm_env_rpc the name of the setting, action or property.
    pub field: Cow<'static, str>,
    /// The value in the request.
    pub got: String,
    /// The values that are allowed, and what the client should do.
    pub expected: String,
}

impl InvalidValue {
    /// Makes the error for this field.
    pub fn new(field: impl Into<Cow<'static, str>>, got: impl ToString, expected: impl ToString) -> Self {
        Self { field: field.into(), got: got.to_string(), expected: expected.to_string() }
    }
}

/// The number of errors since the server started, by class.
#[derive(Clone)]
pub struct ErrorCounters(Arc<[AtomicU64]>);

impl Default for ErrorCounters {
    fn default() -> Self {
        Self(ErrorKind::ALL.iter().map(|_| AtomicU64::new(0)).collect())
    }
}

impl ErrorCounters {
    /// Counts one error of the class `kind`.
    pub fn count(&self, kind: ErrorKind) {
        self.0[kind as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the count of each class. Classes without an error are listed with 0, so Prometheus' `rate` sees their
    /// first error.
    pub fn counts(&self) -> impl Iterator<Item = (ErrorKind, u64)> {
        ErrorKind::ALL.iter().zip(&*self.0).map(|(kind, count)| (*kind, count.load(Ordering::Relaxed)))
    }
}

macro_rules! error_kinds {
    ($($kind:ident = $code:ident, $reason:literal;)*) => {
        /// The class of an error. It contains no client data.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "each has its word in metrics and logs")]
        pub enum ErrorKind { $($kind,)* }

        impl ErrorKind {
            /// All classes, in the order of their numbers.
            const ALL: &[Self] = &[$(Self::$kind,)*];

            /// The gRPC code.
            pub fn code(self) -> Code {
                match self { $(Self::$kind => Code::$code,)* }
            }

            /// The word that names the class in metrics and logs. Classes with the same word have different codes.
            pub fn reason(self) -> &'static str {
                match self { $(Self::$kind => $reason,)* }
            }
        }
    };
}

error_kinds! {
    UnknownEnvironment = NotFound, "unknown_environment";
    UnknownParameter = NotFound, "unknown_parameter";
    BadSnapshot = InvalidArgument, "bad_snapshot";
    Model = Internal, "model";
    BadParameter = InvalidArgument, "bad_parameter";
    EnvironmentsFull = ResourceExhausted, "environments_full";
    EpisodeEnded = FailedPrecondition, "episode_ended";
    BadPolicy = InvalidArgument, "bad_policy";
    Defect = Internal, "defect";
    NoThread = ResourceExhausted, "no_thread";
    NoOpenGl = FailedPrecondition, "no_opengl";
    DrawingFailed = Internal, "drawing_failed";
    NothingToDraw = FailedPrecondition, "nothing_to_draw";
    UnknownLease = NotFound, "unknown_lease";
    OtherToken = PermissionDenied, "other_token";
    NoSuchReply = OutOfRange, "no_such_reply";
    ReplyNotKept = FailedPrecondition, "reply_not_kept";
    TakenUp = Aborted, "taken_up";
    BadValue = InvalidArgument, "bad_value";
    NotOpen = FailedPrecondition, "not_open";
    AlreadyOpen = FailedPrecondition, "already_open";
    WrongOrder = FailedPrecondition, "wrong_order";
    SessionsFull = ResourceExhausted, "sessions_full";
    PeerQuota = ResourceExhausted, "peer_quota";
    NoToken = Unauthenticated, "no_token";
    WrongToken = Unauthenticated, "wrong_token";
    RevokedToken = Unauthenticated, "revoked_token";
    // `MoreThanTokenQuota` is for a request that exceeds the whole quota: a retry cannot help. `TokenQuota` is for a
    // request that exceeds what is left of the quota now.
    MoreThanTokenQuota = InvalidArgument, "token_quota";
    TokenQuota = ResourceExhausted, "token_quota";
    TokenRate = ResourceExhausted, "token_rate";
    Role = PermissionDenied, "role";
    NoLedger = Unavailable, "no_ledger";
    MemoryFull = ResourceExhausted, "memory_full";
    UnfinishedMessage = DeadlineExceeded, "unfinished_message";
    TooLarge = OutOfRange, "too_large";
    Idle = DeadlineExceeded, "idle";
    Draining = Unavailable, "draining";
    UnknownName = NotFound, "unknown_name";
    NotJoined = FailedPrecondition, "not_joined";
    AlreadyJoined = FailedPrecondition, "already_joined";
    Occupied = FailedPrecondition, "occupied";
    NotYours = PermissionDenied, "not_yours";
    NameTaken = AlreadyExists, "name_taken";
    NoRandomness = Unavailable, "no_randomness";
    ForbiddenProperty = PermissionDenied, "forbidden_property";
    UnknownExtension = Unimplemented, "unknown_extension";
}

impl RequestError for InvalidValue {
    fn kind(&self) -> ErrorKind {
        ErrorKind::BadValue
    }
}

impl RequestError for env::Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::UnknownEnvironment(_) => ErrorKind::UnknownEnvironment,
            Self::UnknownParameter { .. } => ErrorKind::UnknownParameter,
            Self::Snapshot { .. } => ErrorKind::BadSnapshot,
            Self::Model { .. } => ErrorKind::Model,
            Self::NotDisturbed { .. } => ErrorKind::WrongOrder,
            _ => ErrorKind::BadParameter,
        }
    }
}

impl RequestError for pool::Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Environment(error) => error.kind(),
            Self::Full { .. } => ErrorKind::EnvironmentsFull,
            Self::Ended { .. } => ErrorKind::EpisodeEnded,
            Self::Policy(_) => ErrorKind::BadPolicy,
            Self::Defect => ErrorKind::Defect,
        }
    }
}

impl RequestError for render::Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::NoThread { .. } => ErrorKind::NoThread,
            Self::Missing { .. } => ErrorKind::NoOpenGl,
            Self::Failed { .. } => ErrorKind::DrawingFailed,
            Self::Defect => ErrorKind::Defect,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn no_two_kinds_share_code_and_reason() {
        let kinds: HashSet<_> = ErrorKind::ALL.iter().map(|kind| (kind.code() as i32, kind.reason())).collect();
        assert_eq!(kinds.len(), ErrorKind::ALL.len());
    }

    #[test]
    fn failed_pictures_say_whose_fault_it_is() {
        let (environment, reason) = ("Hopper", String::new());
        let code = |error: render::Error| error.kind().code();
        assert_eq!(code(render::Error::Missing { environment, reason: reason.clone() }), Code::FailedPrecondition);
        assert_eq!(code(render::Error::NoThread { reason: reason.clone() }), Code::ResourceExhausted);
        assert_eq!(code(render::Error::Failed { environment, reason }), Code::Internal);
        assert_eq!(code(render::Error::Defect), Code::Internal);
    }
}
