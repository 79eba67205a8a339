//! Admission of sessions: the limits of the server, of each peer and of each token, and the refusal during a shutdown.

use super::{
    Error,
    lease::{CountGuard, LeaseCounters},
};
use crate::server::{
    auth::{self, Bearer, QuotaGuard, Token},
    error::{ErrorCounters, RequestError},
    net::{
        access_log::AccessLog,
        peer_limiter::{LimitReached, PeerLimiter, PeerPermit},
    },
    shutdown::{Drain, ShutdownPhase},
    transport::{message_reader::MessageReader, precheck::Decoder},
};
use std::time::Duration;

/// The admission of sessions, within the limits of the server, each peer and each token.
#[derive(Clone)]
pub struct Sessions {
    limiter: PeerLimiter,
    pub(super) limits: SessionLimits,
    pub(super) decoder: Decoder,
    pub(super) drain: Drain,
    counters: ErrorCounters,
    pub(super) access: AccessLog,
    leases: LeaseCounters,
}

/// The limits of one session.
#[derive(Debug, Clone, Copy)]
pub struct SessionLimits {
    /// The maximum length of a request, bytes.
    pub bytes: usize,
    /// The time within which the client must open the session.
    pub handshake: Duration,
    /// The maximum time that an open session waits for its next request; `None` for no limit. A limit shorter than
    /// `handshake` also replaces `handshake`.
    pub idle: Option<Duration>,
}

impl Sessions {
    /// Makes the admission of sessions. `limiter` limits their number, in total and for each peer. Errors are counted
    /// in `counters`, and ended sessions are logged in `access`.
    pub fn new(
        limiter: PeerLimiter,
        limits: SessionLimits,
        drain: Drain,
        counters: ErrorCounters,
        access: AccessLog,
        leases: LeaseCounters,
    ) -> Self {
        Self { limiter, limits, decoder: Decoder::default(), drain, counters, access, leases }
    }

    /// Returns a handle to the same sessions that observes the shutdown through `drain`.
    pub fn with_drain(&self, drain: Drain) -> Self {
        Self { drain, ..self.clone() }
    }

    /// The phase of the shutdown.
    pub fn phase(&self) -> ShutdownPhase {
        self.drain.phase()
    }

    /// Admits a stream. If the server is full and the protocol has leases, the stream may still resume a session.
    pub(super) fn admit(&self, requests: &MessageReader, has_leases: bool) -> Result<Admission, Error> {
        match self.acquire_permits(requests) {
            Err(refusal) if has_leases => self.admit_to_resume(refusal),
            admission => admission,
        }
    }

    /// Returns a handle for a new session. The shutdown counts the session as running until the handle is dropped.
    pub(super) fn enter(&self) -> Self {
        Self { drain: self.drain.enter(), ..self.clone() }
    }

    /// Admits a stream above the session limits, for resuming only: the leased session that the stream resumes already
    /// holds a permit.
    fn admit_to_resume(&self, refusal: Error) -> Result<Admission, Error> {
        let is_full = matches!(
            refusal,
            Error::SessionsFull { .. } | Error::PeerFull { .. } | Error::Auth(auth::Error::QuotaExceeded { .. })
        );
        match self.leases.admit_resuming().filter(|_| is_full) {
            Some(guard) => Ok(Admission::ResumeOnly(guard, refusal)),
            None => Err(refusal),
        }
    }

    /// Counts an error of the server. If the stream has a token, also counts the error for this token.
    pub(super) fn count(&self, error: &impl RequestError, bearer: Option<&Bearer>) {
        self.counters.count(error.kind());
        if let Some(bearer) = bearer {
            bearer.count_error();
        }
    }

    fn acquire_permits(&self, requests: &MessageReader) -> Result<Admission, Error> {
        if self.phase() != ShutdownPhase::Running {
            return Err(Error::Draining);
        }
        let permit = self.limiter.acquire(requests.connection.as_ref().map(|connection| connection.peer));
        let permit = permit.map_err(|full| match full {
            LimitReached::All(limit) => Error::SessionsFull { limit },
            LimitReached::Peer(limit) => Error::PeerFull { limit },
        })?;
        Ok(Admission::Own(permit, requests.bearer.as_ref().map(Token::session).transpose()?))
    }
}

/// The way in which a stream was admitted.
pub(super) enum Admission {
    /// Admitted as a new session, with a permit and a part of its token's quota of sessions.
    Own(#[expect(dead_code, reason = "held")] PeerPermit, #[expect(dead_code, reason = "held")] Option<QuotaGuard>),
    /// Admitted although the server is full. Unless its first request resumes a session, the stream ends with this
    /// error.
    ResumeOnly(#[expect(dead_code, reason = "held")] CountGuard, Error),
}
