//! Admission of sessions: limits of the server, of a peer and of a token, and the shutdown.

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

/// The sessions of a server: their limits, and the shutdown.
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
    /// The most bytes of a request.
    pub bytes: usize,
    /// The time that the session may be silent before it is open.
    pub handshake: Duration,
    /// The time that an open session may be silent; `None` for no limit.
    pub idle: Option<Duration>,
}

impl Sessions {
    /// The sessions that this limiter admits. Errors and endings are counted.
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

    /// The same sessions, with another view of the shutdown.
    pub fn with_drain(&self, drain: Drain) -> Self {
        Self { drain, ..self.clone() }
    }

    /// The phase of the shutdown.
    pub fn phase(&self) -> ShutdownPhase {
        self.drain.phase()
    }

    /// Admits a stream. One that finds the server full may still resume a session if its protocol has leases.
    pub(super) fn admit(&self, requests: &MessageReader, has_leases: bool) -> Result<Admission, Error> {
        match self.acquire_permits(requests) {
            Err(refusal) if has_leases => self.admit_to_resume(refusal),
            admission => admission,
        }
    }

    /// Returns a view for a new session, which counts as running as long as it holds the view.
    pub(super) fn enter(&self) -> Self {
        Self { drain: self.drain.enter(), ..self.clone() }
    }

    /// Admits a stream above the session limits if it may be resuming a leased session, which already holds a permit.
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

    /// Counts an error, and counts it also for the stream's token.
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
    /// Admitted with its own permit, and with a part of its token's quota.
    Own(#[expect(dead_code, reason = "held")] PeerPermit, #[expect(dead_code, reason = "held")] Option<QuotaGuard>),
    /// Admitted although the server is full. If its first request does not resume a session, it ends with this error.
    ResumeOnly(#[expect(dead_code, reason = "held")] CountGuard, Error),
}
