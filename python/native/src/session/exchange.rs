//! Exchange of requests and replies by one thread of the process that opened the stream.

use std::pin::pin;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_protocol::TypedRequest;
use pyo3::prelude::*;

use super::Session;
use super::transport::{SessionServer, Transport};
use crate::embedded::poll_once;
use crate::failure::{RequestFailure, TIMED_OUT, UNUSABLE, failure};
use crate::infos::InfoKeys;
use crate::session_runtime::{SessionRuntime, WaitError};

/// Number of forks between this process and the one that loaded the module.
pub(super) static FORKS: AtomicU32 = AtomicU32::new(0);

/// Notes that this process was forked.
#[pyfunction]
pub fn note_fork() {
    FORKS.fetch_add(1, Ordering::Relaxed);
}

/// The phase of a session.
pub(super) enum SessionState {
    New,
    Idle(Box<OpenSession>),
    /// A thread waits for a reply and owns the open session meanwhile.
    Busy,
    Ended,
}

/// An open session. The transport is dropped before the runtime that drives it.
pub(super) struct OpenSession {
    pub(super) transport: Transport,
    pub(super) runtime: SessionRuntime,
    pub(super) labels: Arc<InfoKeys>,
    /// Steps that were sent and not received.
    pub(super) under_way: usize,
}

impl Session {
    pub(super) fn state(&self) -> MutexGuard<'_, SessionState> {
        unpoisoned(&self.state)
    }

    pub(super) fn deadline(&self) -> Option<Instant> {
        let timeout = *unpoisoned(&self.timeout);
        timeout.and_then(|timeout| Instant::now().checked_add(timeout))
    }

    /// Returns M, the number of environments that the mask selects.
    pub(super) fn selected(&self, mask: &[u8]) -> usize {
        if mask.is_empty() { self.actions.num_envs } else { mask.iter().filter(|&&selected| selected != 0).count() }
    }

    /// Refuses a session of the parent process. A forked process must not touch it: its locks may be held for ever.
    pub(super) fn require_own(&self) -> PyResult<()> {
        let is_own = match self.server {
            SessionServer::Address(..) => std::process::id() == self.owner,
            // A system call for the process would take a tenth of a small step.
            SessionServer::Embedded(_) => self.forks == FORKS.load(Ordering::Relaxed),
        };
        if is_own {
            return Ok(());
        }
        Err(failure(UNUSABLE, 0, "another process opened the session"))
    }

    /// Takes the session for this thread alone, if at most `max_under_way` steps are under way.
    pub(super) fn take(&self, max_under_way: usize) -> PyResult<Box<OpenSession>> {
        self.require_own()?;
        let mut state = self.state();
        match std::mem::replace(&mut *state, SessionState::Busy) {
            SessionState::Idle(open) if open.under_way <= max_under_way => Ok(open),
            SessionState::Idle(open) => {
                let under_way = open.under_way;
                *state = SessionState::Idle(open);
                Err(failure(UNUSABLE, 0, format!("steps are under way, {under_way} of them: recv() first")))
            }
            SessionState::Busy => Err(failure(
                UNUSABLE,
                0,
                "another thread waits for a reply: an environment is for one thread at a time",
            )),
            before => {
                *state = before;
                Err(failure(UNUSABLE, 0, "the session is not open"))
            }
        }
    }

    pub(super) fn put_back(&self, py: Python<'_>, open: Box<OpenSession>) {
        let mut state = self.state();
        if self.closing.is_closed() {
            *state = SessionState::Ended;
            drop(state);
            open.close(py);
        } else {
            *state = SessionState::Idle(open);
        }
    }

    pub(super) fn end(&self) {
        *self.state() = SessionState::Ended;
    }

    pub(super) fn ask<A>(
        &self,
        py: Python<'_>,
        open: Box<OpenSession>,
        request: A,
    ) -> PyResult<(Arc<InfoKeys>, A::Reply)>
    where
        A: TypedRequest + Send + 'static,
        A::Reply: Send,
    {
        self.exchange::<A>(py, open, Some(request))
    }

    pub(super) fn receive<A>(&self, py: Python<'_>, mut open: Box<OpenSession>) -> PyResult<(Arc<InfoKeys>, A::Reply)>
    where
        A: TypedRequest + Send + 'static,
        A::Reply: Send,
    {
        open.under_way -= 1;
        self.exchange::<A>(py, open, None)
    }

    /// Sends a request and receives its reply. `None` sends nothing and receives the reply of the oldest step that was sent
    /// ahead. After a refusal the session goes on; other errors end it.
    fn exchange<A>(
        &self,
        py: Python<'_>,
        mut open: Box<OpenSession>,
        request: Option<A>,
    ) -> PyResult<(Arc<InfoKeys>, A::Reply)>
    where
        A: TypedRequest + Send + 'static,
        A::Reply: Send,
    {
        let OpenSession { transport, runtime, labels, .. } = &mut *open;
        let labels = Arc::clone(labels);
        // A future for both would be as large as the larger one, and is moved.
        let come = match transport {
            Transport::Stream { stream, .. } => {
                let pending = pin!(Transport::exchange(stream, request));
                runtime.wait(py, pending, self.deadline(), &self.closing)
            }
            Transport::Embedded(stream) => {
                let mut pending = pin!(stream.exchange(request));
                match runtime.now(py, || poll_once(pending.as_mut())) {
                    Some(come) => Ok(come),
                    None => runtime.wait(py, pending, self.deadline(), &self.closing),
                }
            }
        };
        match come {
            Ok(Ok(reply)) => {
                self.put_back(py, open);
                Ok((labels, reply))
            }
            Ok(Err(RequestFailure::Refused(error))) => {
                self.put_back(py, open);
                Err(error)
            }
            Ok(Err(RequestFailure::Ended(error))) => {
                self.end();
                Err(error)
            }
            Err(broken) => {
                // The late reply would be taken for the reply to the next request.
                open.close(py);
                self.end();
                Err(explain(broken))
            }
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        if std::process::id() != self.owner {
            // The session is a copy of the parent's. Its locks may be held for ever, and its connection is the parent's.
            let state = self.state.get_mut().unwrap_or_else(PoisonError::into_inner);
            std::mem::forget(std::mem::replace(state, SessionState::Ended));
        }
    }
}

impl OpenSession {
    /// Ends the stream by a message, so that the server frees the environments even if a forked process holds the socket.
    pub(super) fn close(self, py: Python<'_>) {
        let Self { transport, runtime, .. } = self;
        let is_embedded = transport.is_embedded();
        py.detach(|| {
            drop(transport);
            if !is_embedded {
                runtime.poll_io();
            }
        });
    }
}

/// Ends a session when dropped, unless its opening succeeded and forgot the guard.
pub(super) struct OpeningGuard<'a>(pub(super) &'a Session);

impl Drop for OpeningGuard<'_> {
    fn drop(&mut self) {
        self.0.end();
    }
}

pub(super) fn explain(broken: WaitError) -> PyErr {
    match broken {
        WaitError::Interrupted(error) => error,
        WaitError::TimedOut => failure(TIMED_OUT, 0, ""),
        WaitError::Closed => failure(UNUSABLE, 0, "another thread closed the session"),
    }
}

/// Converts seconds to a duration. Returns `None`, no limit, for infinity and for more than a `Duration` holds.
pub(super) fn duration(seconds: f64) -> Option<Duration> {
    Duration::try_from_secs_f64(seconds).ok()
}

pub(super) fn unpoisoned<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
