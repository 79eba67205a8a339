//! Leases: sessions that outlive the loss of their stream for a while, and continue in another.
//!
//! - This module: the leases of a server, and how a new stream asks for one.
//! - [`replay_buffer`](super::replay_buffer): replies that may not have been received.
//! - The `driver` module runs sessions with and without a lease, and waits for their streams.

use crate::server::{
    auth::Bearer,
    error::{ErrorKind, RequestError},
    id::{Id, NoRandomness, random},
    shutdown::Drain,
    transport::{budget::MemoryReservation, message_reader::MessageReader},
};
use std::{
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};
use subtle::ConstantTimeEq;
use tokio::{
    runtime::Handle,
    sync::{mpsc, oneshot},
};
use tonic::Status;

/// The maximum number of stored replies of a session with a lease. It also limits the unanswered requests.
pub const MAX_STORED_REPLIES: u32 = 64;

/// Why a session cannot be resumed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No session has this lease.
    #[error("no session here has the lease that came: it is over, or its session has ended; open another session")]
    Unknown,
    /// The session belongs to another token.
    #[error("the session was opened with another token; show the one that it was opened with, or open another session")]
    OtherToken,
    /// The client names a reply that was never sent.
    #[error(
        "last_reply is {got}, but {last} is the last reply so far; opened is 0, and each response after it one more"
    )]
    NoReply {
        /// The number that came.
        got: u64,
        /// The last one.
        last: u64,
    },
    /// Some replies after `got` are no longer stored.
    #[error(
        "last_reply is {got}, but replies up to {first} are kept no more: open.lease said that so many requests would not \
         wait, or there was no memory for them; open another session"
    )]
    Forgotten {
        /// The number that came.
        got: u64,
        /// The smallest `last_reply` from which the session can be resumed.
        first: u64,
    },
    /// Another stream has resumed the session.
    #[error("another stream has resumed this session by its lease; continue there")]
    TakenUp,
}

impl RequestError for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Unknown => ErrorKind::UnknownLease,
            Self::OtherToken => ErrorKind::OtherToken,
            Self::NoReply { .. } => ErrorKind::NoSuchReply,
            Self::Forgotten { .. } => ErrorKind::ReplyNotKept,
            Self::TakenUp => ErrorKind::TakenUp,
        }
    }
}

/// A response on its way to a stream.
pub struct OutgoingResponse<R> {
    /// The response.
    pub response: R,
    /// The reservation for the response until it is sent.
    pub memory: Option<MemoryReservation>,
}

/// Sends responses to a stream, or the status that ends it.
pub type ResponseSender<R> = mpsc::Sender<Result<OutgoingResponse<R>, Status>>;

/// The leases of a server's sessions of one protocol, whose responses are `R`.
pub struct Leases<R>(Arc<LeaseRegistry<R>>);

impl<R> Clone for Leases<R> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

struct LeaseRegistry<R> {
    time: Duration,
    counters: LeaseCounters,
    leases: Mutex<Vec<LeaseEntry<R>>>,
}

/// A lease that a session holds.
struct LeaseEntry<R> {
    name: Id,
    bearer: Option<Bearer>,
    resume_requests: mpsc::Sender<ResumeRequest<R>>,
}

/// Counters of leases.
#[derive(Clone, Default)]
pub struct LeaseCounters(Arc<LeaseCounts>);

#[derive(Default)]
struct LeaseCounts {
    held: AtomicUsize,
    detached: AtomicUsize,
    resumed: AtomicU64,
    spares: AtomicUsize,
}

impl LeaseCounters {
    /// Sessions without a stream now.
    pub fn detached(&self) -> usize {
        self.0.detached.load(Ordering::Relaxed)
    }

    /// The number of times that a session was resumed so far.
    pub fn resumed(&self) -> u64 {
        self.0.resumed.load(Ordering::Relaxed)
    }

    /// Counts a session that was resumed.
    pub fn add_resumed(&self) {
        self.0.resumed.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a session that has no stream, until the guard is dropped.
    pub fn detach(&self) -> CountGuard {
        self.0.detached.fetch_add(1, Ordering::Relaxed);
        CountGuard { counters: self.clone(), counter: |counts| &counts.detached }
    }

    /// Admits one stream over the limit for resuming only. There are at most as many as leases.
    pub fn admit_resuming(&self) -> Option<CountGuard> {
        let held = self.0.held.load(Ordering::Relaxed);
        let taken = |spares: usize| (spares < held).then_some(spares + 1);
        self.0.spares.fetch_update(Ordering::Relaxed, Ordering::Relaxed, taken).ok()?;
        Some(CountGuard { counters: self.clone(), counter: |counts| &counts.spares })
    }
}

/// Counts one until it is dropped.
pub struct CountGuard {
    counters: LeaseCounters,
    counter: fn(&LeaseCounts) -> &AtomicUsize,
}

impl Drop for CountGuard {
    fn drop(&mut self) {
        (self.counter)(&self.counters.0).fetch_sub(1, Ordering::Relaxed);
    }
}

/// A stream's request to resume a session.
pub struct ResumeRequest<R> {
    /// The number of the last reply that its client received.
    pub last_reply: u64,
    /// The sender for the answer of the session.
    pub answer: oneshot::Sender<Result<ResumeAccepted<R>, Error>>,
}

/// The positive answer to a stream that resumes a session.
pub struct ResumeAccepted<R> {
    /// The number of the session's last reply.
    pub last_reply: u64,
    /// The sender by which the stream goes to the session.
    pub stream: oneshot::Sender<ResumingStream<R>>,
}

/// A stream that resumes a session.
pub struct ResumingStream<R> {
    /// The requests of the stream.
    pub requests: MessageReader,
    /// The sender of its responses.
    pub responses: ResponseSender<R>,
    /// The view of the shutdown of the stream's thread.
    pub drain: Drain,
    /// The runtime of the stream's thread, on which the session goes on.
    pub runtime: Handle,
}

/// A session's lease, until it is dropped.
pub struct LeaseGuard<R> {
    leases: Leases<R>,
    /// The name of the session.
    pub name: Id,
    /// The maximum number of unanswered requests of its client.
    pub max_unanswered: usize,
    /// The streams that ask to resume the session.
    pub resume_requests: mpsc::Receiver<ResumeRequest<R>>,
}

impl<R> Leases<R> {
    /// No leases yet. Each holds for `time` without a stream.
    pub fn new(time: Duration, counters: LeaseCounters) -> Self {
        Self(Arc::new(LeaseRegistry { time, counters, leases: Mutex::default() }))
    }

    /// Grants a session a lease, unless leases are switched off.
    ///
    /// # Errors
    /// [`NoRandomness`].
    pub fn grant(&self, bearer: Option<Bearer>, max_unanswered: usize) -> Result<Option<LeaseGuard<R>>, NoRandomness> {
        if self.0.time.is_zero() {
            return Ok(None);
        }
        let name = random()?;
        // The session answers one of them at a time.
        let (sender, resume_requests) = mpsc::channel(1);
        self.lock().push(LeaseEntry { name, bearer, resume_requests: sender });
        self.0.counters.0.held.fetch_add(1, Ordering::Relaxed);
        Ok(Some(LeaseGuard { leases: self.clone(), name, max_unanswered, resume_requests }))
    }

    /// Asks to resume the session of this name, for a client that received replies up to a number.
    ///
    /// # Errors
    /// [`Error`].
    pub async fn resume(
        &self,
        name: &[u8],
        bearer: Option<&Bearer>,
        last_reply: u64,
    ) -> Result<ResumeAccepted<R>, Error> {
        let (answer, answered) = oneshot::channel();
        let resume_requests = self.find(name, bearer)?;
        resume_requests.send(ResumeRequest { last_reply, answer }).await.map_err(|_| Error::Unknown)?;
        answered.await.map_err(|_| Error::Unknown)?
    }

    fn find(&self, name: &[u8], bearer: Option<&Bearer>) -> Result<mpsc::Sender<ResumeRequest<R>>, Error> {
        let leases = self.lock();
        // Every lease is compared, each in constant time, so that the time does not reveal a name.
        let found = leases
            .iter()
            .fold(None, |found, lease| if lease.name[..].ct_eq(name).into() { Some(lease) } else { found });
        let LeaseEntry { bearer: own, resume_requests, .. } = found.ok_or(Error::Unknown)?;
        // The names are enough: a revoked token loses its sessions, so a new token of the same name finds none.
        if own.as_ref().map(|own| own.name()) != bearer.map(|bearer| bearer.name()) {
            return Err(Error::OtherToken);
        }
        Ok(resume_requests.clone())
    }

    fn lock(&self) -> MutexGuard<'_, Vec<LeaseEntry<R>>> {
        self.0.leases.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<R> LeaseGuard<R> {
    /// The time that the lease holds without a stream.
    pub fn time(&self) -> Duration {
        self.leases.0.time
    }

    /// Counters of leases.
    pub fn counters(&self) -> &LeaseCounters {
        &self.leases.0.counters
    }
}

impl<R> Drop for LeaseGuard<R> {
    fn drop(&mut self) {
        self.leases.lock().retain(|lease| lease.name != self.name);
        self.counters().0.held.fetch_sub(1, Ordering::Relaxed);
    }
}
