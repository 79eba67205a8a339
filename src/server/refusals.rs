//! The kinds of refusals, and how often each happened.

use super::{auth::Bearer, session::lease, status::Refusal};
use crate::{env, pool, render};
use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};
use tonic::Code;

/// Refusals since the server began, by their kind.
#[derive(Clone)]
pub struct Refusals(Arc<[AtomicU64]>);

impl Default for Refusals {
    fn default() -> Self {
        Self(Kind::ALL.iter().map(|_| AtomicU64::new(0)).collect())
    }
}

impl Refusals {
    /// Adds one, to who has this token.
    pub fn count(&self, refusal: &Refusal, bearer: Option<&Bearer>) {
        self.0[refusal.kind() as usize].fetch_add(1, Ordering::Relaxed);
        if let Some(bearer) = bearer {
            bearer.refused();
        }
    }

    /// How often each kind happened, those that never did among them: who watches a counter sees its first event by
    /// the 0 before.
    pub fn counts(&self) -> impl Iterator<Item = (Kind, u64)> {
        Kind::ALL.iter().zip(&*self.0).map(|(kind, count)| (*kind, count.load(Ordering::Relaxed)))
    }
}

macro_rules! kinds {
    ($($kind:ident = $code:ident, $reason:literal;)*) => {
        /// What kind a refusal is of: nothing that a client sent is in it.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[allow(missing_docs, reason = "each has its word in metrics and logs")]
        pub enum Kind { $($kind,)* }

        impl Kind {
            /// All that there are, in the order of their numbers.
            const ALL: &[Self] = &[$(Self::$kind,)*];

            /// The gRPC code.
            pub fn code(self) -> Code {
                match self { $(Self::$kind => Code::$code,)* }
            }

            /// The word of metrics and logs; no two kinds share it and the code.
            pub fn reason(self) -> &'static str {
                match self { $(Self::$kind => $reason,)* }
            }
        }
    };
}

kinds! {
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
    // More than the token may ever have, which is not to be tried again, and more than is left.
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

impl Refusal {
    /// What kind this refusal is of.
    pub fn kind(&self) -> Kind {
        match self {
            Self::Environment(error) | Self::Pool(pool::Error::Environment(error)) => match error {
                env::Error::UnknownEnvironment(_) => Kind::UnknownEnvironment,
                env::Error::UnknownParameter { .. } => Kind::UnknownParameter,
                env::Error::Snapshot { .. } => Kind::BadSnapshot,
                env::Error::Model { .. } => Kind::Model,
                _ => Kind::BadParameter,
            },
            Self::Pool(pool::Error::Full { .. }) => Kind::EnvironmentsFull,
            Self::Pool(pool::Error::Ended { .. }) => Kind::EpisodeEnded,
            Self::Pool(pool::Error::Policy(_)) => Kind::BadPolicy,
            Self::Pool(pool::Error::Defect) | Self::Render(render::Error::Defect) => Kind::Defect,
            Self::Render(render::Error::NoThread { .. }) => Kind::NoThread,
            Self::Render(render::Error::Missing { .. }) => Kind::NoOpenGl,
            Self::Render(render::Error::Failed { .. }) => Kind::DrawingFailed,
            Self::NothingToDraw { .. } => Kind::NothingToDraw,
            Self::Lease(error) => match error {
                lease::Error::Unknown => Kind::UnknownLease,
                lease::Error::OtherToken => Kind::OtherToken,
                lease::Error::NoReply { .. } => Kind::NoSuchReply,
                lease::Error::Forgotten { .. } => Kind::ReplyNotKept,
                lease::Error::TakenUp => Kind::TakenUp,
            },
            Self::Value { .. } => Kind::BadValue,
            Self::NotOpen { .. } => Kind::NotOpen,
            Self::AlreadyOpen => Kind::AlreadyOpen,
            Self::Order { .. } => Kind::WrongOrder,
            Self::TooManySessions { .. } => Kind::SessionsFull,
            Self::TooManyOfAPeer { .. } => Kind::PeerQuota,
            Self::NoToken => Kind::NoToken,
            Self::WrongToken => Kind::WrongToken,
            Self::RevokedToken { .. } => Kind::RevokedToken,
            Self::TooManyOfAToken { wanted, limit, .. } if wanted > limit => Kind::MoreThanTokenQuota,
            Self::TooManyOfAToken { .. } => Kind::TokenQuota,
            Self::TooFast { .. } => Kind::TokenRate,
            Self::NotAllowed { .. } => Kind::Role,
            Self::NoLedger { .. } => Kind::NoLedger,
            Self::NoMemory { .. } => Kind::MemoryFull,
            Self::Unfinished { .. } => Kind::UnfinishedMessage,
            Self::TooLarge { .. } => Kind::TooLarge,
            Self::Idle { .. } => Kind::Idle,
            Self::Draining => Kind::Draining,
            Self::Unknown { .. } => Kind::UnknownName,
            Self::NotJoined { .. } => Kind::NotJoined,
            Self::AlreadyJoined { .. } => Kind::AlreadyJoined,
            Self::Occupied { .. } => Kind::Occupied,
            Self::NotYours { .. } => Kind::NotYours,
            Self::Taken { .. } => Kind::NameTaken,
            Self::NoRandomness => Kind::NoRandomness,
            Self::Forbidden { .. } => Kind::ForbiddenProperty,
            Self::UnknownExtension { .. } => Kind::UnknownExtension,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn no_two_kinds_share_code_and_reason() {
        let kinds: HashSet<_> = Kind::ALL.iter().map(|kind| (kind.code() as i32, kind.reason())).collect();
        assert_eq!(kinds.len(), Kind::ALL.len());
    }

    #[test]
    fn kinds_are_counted_by_themselves() {
        let refusals = Refusals::default();
        let of_a_token = |wanted| Refusal::TooManyOfAToken { name: "ann".into(), wanted, limit: 4, what: "sessions" };
        for refusal in [of_a_token(5), of_a_token(1), of_a_token(4), Refusal::NoToken] {
            refusals.count(&refusal, None);
        }
        let counted: Vec<_> = refusals.counts().filter(|(_, count)| *count > 0).collect();
        assert_eq!(counted, [(Kind::NoToken, 1), (Kind::MoreThanTokenQuota, 1), (Kind::TokenQuota, 2)]);
    }
}
