//! Leases: a session with a lease outlives the loss of its stream for a while, and continues on another stream.
//!
//! - This module: a server's leases, and the requests with which a new stream resumes a session.
//! - [`replay_buffer`](super::replay_buffer): stores replies that the client may not have received.
//! - The `driver` module runs sessions with and without a lease, and waits for new streams.

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

/// The maximum number of stored replies of a session with a lease. A client may not have more unanswered requests.
pub const MAX_STORED_REPLIES: u32 = 64;

/// Why a session cannot be resumed, or why its old stream ends.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No session has this lease.
    #[error("no session of this server has this lease: it has expired, or the session has ended; open another session")]
    Unknown,
    /// The session belongs to another token.
    #[error("the session was opened with another token; use that token, or open another session")]
    OtherToken,
    /// The client claims to have received a reply that was never sent.
    #[error("last_reply is {got}, but the session's last reply so far is {last}; the reply to open has number 0")]
    NoReply {
        /// The `last_reply` of the client.
        got: u64,
        /// The number of the session's last reply.
        last: u64,
    },
    /// The client needs all replies after number `got`, but some of these replies are no longer stored.
    #[error(
        "last_reply is {got}, but replies up to {first} are no longer stored, because more requests were unanswered than \
         open.lease allows, or there was no memory; open another session"
    )]
    Forgotten {
        /// The `last_reply` of the client.
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

/// A response with its memory reservation, to be sent on a stream.
pub struct OutgoingResponse<R> {
    /// The response.
    pub response: R,
    /// The memory reservation for the response, held until the response is sent.
    pub memory: Option<MemoryReservation>,
}

/// A sender of responses to a client's stream, or of the status that ends it.
pub type ResponseSender<R> = mpsc::Sender<Result<OutgoingResponse<R>, Status>>;

/// All leases of a server's sessions in one protocol. `R` is the protocol's response.
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

/// A session's lease in the registry.
struct LeaseEntry<R> {
    name: Id,
    bearer: Option<Bearer>,
    resume_requests: mpsc::Sender<ResumeRequest<R>>,
}

/// The counters of leases, of sessions without a stream, of resumed sessions, and of streams admitted above the session
/// limit.
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
    /// The number of sessions that have no stream now.
    pub fn detached(&self) -> usize {
        self.0.detached.load(Ordering::Relaxed)
    }

    /// The number of times that sessions were resumed since the server started.
    pub fn resumed(&self) -> u64 {
        self.0.resumed.load(Ordering::Relaxed)
    }

    /// Counts one more resumed session.
    pub fn add_resumed(&self) {
        self.0.resumed.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a session as having no stream until the guard is dropped.
    pub fn detach(&self) -> CountGuard {
        self.0.detached.fetch_add(1, Ordering::Relaxed);
        CountGuard { counters: self.clone(), counter: |counts| &counts.detached }
    }

    /// Admits one stream above the session limit, for resuming only. Returns `None` if there are already as many such
    /// streams as leases.
    pub fn admit_resuming(&self) -> Option<CountGuard> {
        let held = self.0.held.load(Ordering::Relaxed);
        let taken = |spares: usize| (spares < held).then_some(spares + 1);
        self.0.spares.fetch_update(Ordering::Relaxed, Ordering::Relaxed, taken).ok()?;
        Some(CountGuard { counters: self.clone(), counter: |counts| &counts.spares })
    }
}

/// A guard that keeps one of the [`LeaseCounters`] raised by one until it is dropped.
pub struct CountGuard {
    counters: LeaseCounters,
    counter: fn(&LeaseCounts) -> &AtomicUsize,
}

impl Drop for CountGuard {
    fn drop(&mut self) {
        (self.counter)(&self.counters.0).fetch_sub(1, Ordering::Relaxed);
    }
}

/// A new stream's request to resume a session.
pub struct ResumeRequest<R> {
    /// The number of the last reply that the client received.
    pub last_reply: u64,
    /// The channel for the session's answer.
    pub answer: oneshot::Sender<Result<ResumeAccepted<R>, Error>>,
}

/// A session's positive answer to a [`ResumeRequest`].
pub struct ResumeAccepted<R> {
    /// The number of the session's last reply.
    pub last_reply: u64,
    /// The channel over which the new stream is passed to the session.
    pub stream: oneshot::Sender<ResumingStream<R>>,
}

/// A new stream, passed to the session that it resumes.
pub struct ResumingStream<R> {
    /// The reader of the stream's requests.
    pub requests: MessageReader,
    /// The sender for responses to the stream.
    pub responses: ResponseSender<R>,
    /// The handle with which the stream's transport thread observes the shutdown.
    pub drain: Drain,
    /// The runtime of the stream's transport thread. The session continues on it.
    pub runtime: Handle,
}

/// A session's lease. The lease ends when the guard is dropped.
pub struct LeaseGuard<R> {
    leases: Leases<R>,
    /// The random name with which a client resumes the session.
    pub name: Id,
    /// The maximum number of unanswered requests of the session's client.
    pub max_unanswered: usize,
    /// The requests of new streams to resume the session.
    pub resume_requests: mpsc::Receiver<ResumeRequest<R>>,
}

impl<R> Leases<R> {
    /// Makes an empty registry. A session without a stream keeps its lease for `time`.
    pub fn new(time: Duration, counters: LeaseCounters) -> Self {
        Self(Arc::new(LeaseRegistry { time, counters, leases: Mutex::default() }))
    }

    /// Grants a lease to a session whose token is `bearer`. Returns `None` if leases are switched off.
    ///
    /// # Errors
    /// [`NoRandomness`], if the operating system has no random bits for the lease's name.
    pub fn grant(&self, bearer: Option<Bearer>, max_unanswered: usize) -> Result<Option<LeaseGuard<R>>, NoRandomness> {
        if self.0.time.is_zero() {
            return Ok(None);
        }
        let name = random()?;
        // A capacity of one is enough, because the session answers one resume request at a time.
        let (sender, resume_requests) = mpsc::channel(1);
        self.lock().push(LeaseEntry { name, bearer, resume_requests: sender });
        self.0.counters.0.held.fetch_add(1, Ordering::Relaxed);
        Ok(Some(LeaseGuard { leases: self.clone(), name, max_unanswered, resume_requests }))
    }

    /// Sends a resume request to the session whose lease has this name. `last_reply` is the number of the last reply
    /// that the client received.
    ///
    /// # Errors
    /// [`Error`], if there is no such session, if it belongs to another token, or if it cannot be resumed from that
    /// reply.
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
        // Compares all leases, each in constant time, so that response times do not help to guess a name.
        let found = leases
            .iter()
            .fold(None, |found, lease| if lease.name[..].ct_eq(name).into() { Some(lease) } else { found });
        let LeaseEntry { bearer: own, resume_requests, .. } = found.ok_or(Error::Unknown)?;
        // Comparing the tokens' names is enough: a revoked token loses its sessions, so a new token of the same name
        // cannot inherit any.
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
    /// The time for which the session may be without a stream before the lease expires.
    pub fn time(&self) -> Duration {
        self.leases.0.time
    }

    /// The counters that include this lease.
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
