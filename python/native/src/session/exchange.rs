//! Exchange of requests and replies. Only one thread at a time, in the process that opened the stream, can do it.

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

/// Number of forks since the module was loaded, in the chain of processes that led to this process.
pub(super) static FORKS: AtomicU32 = AtomicU32::new(0);

/// Counts a fork. Python calls this function in each forked process.
#[pyfunction]
pub fn note_fork() {
    FORKS.fetch_add(1, Ordering::Relaxed);
}

/// The phase of a session.
pub(super) enum SessionState {
    New,
    Idle(Box<OpenSession>),
    /// A thread is waiting for a reply. It owns the open session until the reply arrives.
    Busy,
    Ended,
}

/// An open session. The transport is dropped before the runtime that drives it.
pub(super) struct OpenSession {
    pub(super) transport: Transport,
    pub(super) runtime: SessionRuntime,
    pub(super) labels: Arc<InfoKeys>,
    /// Number of steps that were sent and whose reply was not received yet.
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

    /// Returns the number M of environments that the mask selects. An empty mask selects all.
    pub(super) fn selected(&self, mask: &[u8]) -> usize {
        if mask.is_empty() { self.actions.num_envs } else { mask.iter().filter(|&&selected| selected != 0).count() }
    }

    /// Checks that this process made the session. A forked process must not use the session of its parent, whose locks
    /// may be held forever.
    pub(super) fn require_own(&self) -> PyResult<()> {
        let is_own = match self.server {
            SessionServer::Address(..) => std::process::id() == self.owner,
            // The system call for the process's id would take a tenth of the time of a small step.
            SessionServer::Embedded(_) => self.forks == FORKS.load(Ordering::Relaxed),
        };
        if is_own {
            return Ok(());
        }
        Err(failure(UNUSABLE, 0, "another process opened the session"))
    }

    /// Takes the open session for this thread. Fails if more than `max_under_way` steps are under way, i.e. were sent
    /// and not received.
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

    /// Sends a request and receives its reply. `None` sends nothing, and receives the reply to the oldest step that was
    /// sent and not received. If the server refuses the request, the session can be used further. All other errors end
    /// it.
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
        let busy = BusyGuard(self);
        let OpenSession { transport, runtime, labels, .. } = &mut *open;
        let labels = Arc::clone(labels);
        // Two separate futures, because a common one would have the size of the larger and would have to be moved.
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
                std::mem::forget(busy);
                self.put_back(py, open);
                Ok((labels, reply))
            }
            Ok(Err(RequestFailure::Refused(error))) => {
                std::mem::forget(busy);
                self.put_back(py, open);
                Err(error)
            }
            Ok(Err(RequestFailure::Ended(error))) => Err(error),
            Err(broken) => {
                // The late reply would be taken for the reply to the next request.
                open.close(py);
                Err(explain(broken))
            }
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        if std::process::id() != self.owner {
            // This session is a fork's copy of the parent's session. It is not dropped, because its locks may be held
            // forever, and because its connection belongs to the parent.
            let state = self.state.get_mut().unwrap_or_else(PoisonError::into_inner);
            std::mem::forget(std::mem::replace(state, SessionState::Ended));
        }
    }
}

impl OpenSession {
    /// Ends the stream with a message to the server. The server then frees the environments even if a forked process
    /// keeps the socket open.
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

/// A guard that ends a busy session when the guard is dropped, also by a panic, so that no session stays busy for ever.
/// If the session continues, the caller passes the guard to [`std::mem::forget`].
pub(super) struct BusyGuard<'a>(pub(super) &'a Session);

impl Drop for BusyGuard<'_> {
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

/// Converts seconds to a duration. Returns `None`, which means no limit, if the number is infinite or too large.
pub(super) fn duration(seconds: f64) -> Option<Duration> {
    Duration::try_from_secs_f64(seconds).ok()
}

pub(super) fn unpoisoned<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
