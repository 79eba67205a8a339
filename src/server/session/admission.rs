//! Who may have a session: places of the server, of a peer and of a token, and the shutdown.

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
    shutdown::{Drain, Phase},
    transport::{message_reader::MessageReader, precheck::Decoder},
};
use std::time::Duration;

/// What all sessions of the server are subject to: their number, how long they may be silent, and the shutdown.
#[derive(Clone)]
pub struct Sessions {
    places: PeerLimiter,
    pub(super) limits: SessionLimits,
    pub(super) decoder: Decoder,
    pub(super) drain: Drain,
    counters: ErrorCounters,
    pub(super) access: AccessLog,
    leases: LeaseCounters,
}

/// What a session may do.
#[derive(Debug, Clone, Copy)]
pub struct SessionLimits {
    /// The most bytes of a request.
    pub bytes: usize,
    /// How long it may be silent before it is open.
    pub handshake: Duration,
    /// How long it may be silent when it is open; none: for ever.
    pub idle: Option<Duration>,
}

impl Sessions {
    /// Sessions for which there are these places. What is refused and how they end is counted.
    pub fn new(
        places: PeerLimiter,
        limits: SessionLimits,
        drain: Drain,
        counters: ErrorCounters,
        access: AccessLog,
        leases: LeaseCounters,
    ) -> Self {
        Self { places, limits, decoder: Decoder::default(), drain, counters, access, leases }
    }

    /// How far the shutdown is.
    pub fn phase(&self) -> Phase {
        self.drain.phase()
    }

    /// Lets a stream in, or says why not. One that finds the server full may still take up a session if its protocol has
    /// leases.
    pub(super) fn admit(&self, requests: &MessageReader, has_leases: bool) -> Result<Admission, Error> {
        match self.take_place(requests) {
            Err(refusal) if has_leases => self.admit_to_resume(refusal),
            seat => seat,
        }
    }

    /// What a new session is subject to. It counts as running as long as it holds this.
    pub(super) fn enter(&self) -> Self {
        Self { drain: self.drain.enter(), ..self.clone() }
    }

    /// Lets a stream in for which there is no place, if it might be one that takes up a session, which has a place.
    fn admit_to_resume(&self, refusal: Error) -> Result<Admission, Error> {
        let is_full = matches!(
            refusal,
            Error::SessionsFull { .. } | Error::PeerFull { .. } | Error::Auth(auth::Error::QuotaExceeded { .. })
        );
        match self.leases.spare().filter(|_| is_full) {
            Some(spare) => Ok(Admission::Spare(spare, refusal)),
            None => Err(refusal),
        }
    }

    /// Counts an error, also for the token that the stream has.
    pub(super) fn count(&self, error: &impl RequestError, bearer: Option<&Bearer>) {
        self.counters.count(error.kind());
        if let Some(bearer) = bearer {
            bearer.refused();
        }
    }

    fn take_place(&self, requests: &MessageReader) -> Result<Admission, Error> {
        if self.phase() != Phase::Running {
            return Err(Error::Draining);
        }
        let place = self.places.take(requests.connection.as_ref().map(|connection| connection.peer));
        let place = place.map_err(|full| match full {
            LimitReached::All(limit) => Error::SessionsFull { limit },
            LimitReached::Peer(limit) => Error::PeerFull { limit },
        })?;
        Ok(Admission::Own(place, requests.bearer.as_ref().map(Token::session).transpose()?))
    }
}

/// What a stream was let in on.
pub(super) enum Admission {
    /// A place of its own, with that of its token.
    Own(#[expect(dead_code, reason = "held")] PeerPermit, #[expect(dead_code, reason = "held")] Option<QuotaGuard>),
    /// That it takes up a session; otherwise this is its refusal.
    Spare(#[expect(dead_code, reason = "held")] CountGuard, Error),
}
