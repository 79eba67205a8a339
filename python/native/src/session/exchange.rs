//! Exchange of requests and replies. Only the process that opened the session can use it, and only one of its threads
//! at a time.

use std::pin::pin;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_protocol::TypedRequest;
use pyo3::prelude::*;

use super::PythonSession;
use super::transport::{SessionServer, Transport};
use crate::embedded::poll_once;
use crate::failure::{RequestFailure, TIMED_OUT, UNUSABLE, failure};
use crate::infos::InfoKeys;
use crate::session_runtime::{SessionRuntime, WaitError};

/// Number of forks that lead from the process that loaded this module to this process.
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

/// An open session. Fields are dropped in order: the transport before the runtime, because the runtime drives it.
pub(super) struct OpenSession {
    pub(super) transport: Transport,
    pub(super) runtime: SessionRuntime,
    pub(super) labels: Arc<InfoKeys>,
    /// Number of steps that were sent and whose reply was not received yet.
    pub(super) under_way: usize,
}

impl PythonSession {
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

    /// Checks that this process made the session. A forked process must not use the session of its parent: if another
    /// thread held one of the session's locks during the fork, the lock is never released in the forked process.
    pub(super) fn require_own(&self) -> PyResult<()> {
        let is_own = match self.server {
            SessionServer::Address(..) => std::process::id() == self.owner,
            // Compare the number of forks, not the process's id. The system call for the id would take a tenth of the
            // time of a small step.
            SessionServer::Embedded(_) => self.forks == FORKS.load(Ordering::Relaxed),
        };
        if is_own {
            return Ok(());
        }
        Err(failure(UNUSABLE, 0, "another process opened the session"))
    }

    /// Takes the open session for this thread, and marks it as busy. Fails if more than `max_under_way` steps still
    /// have unreceived replies.
    pub(super) fn take(&self, max_under_way: usize) -> PyResult<Box<OpenSession>> {
        self.require_own()?;
        let mut state = self.state();
        match std::mem::replace(&mut *state, SessionState::Busy) {
            SessionState::Idle(open) if open.under_way <= max_under_way => Ok(open),
            SessionState::Idle(open) => {
                let under_way = open.under_way;
                *state = SessionState::Idle(open);
                let steps = if under_way == 1 { "step is" } else { "steps are" };
                Err(failure(UNUSABLE, 0, format!("{under_way} {steps} under way: call recv() first")))
            }
            SessionState::Busy => Err(failure(
                UNUSABLE,
                0,
                "another thread waits for a reply: only one thread at a time may use an environment",
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

    /// Sends a request and receives its reply. `None` sends nothing, and receives the oldest reply to a step that was
    /// sent. If the server refuses the request, the session can be used further. All other errors end the session.
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
        // Each transport has its own future. A common future type would have the size of the larger one, and would have
        // to be moved.
        let outcome = match transport {
            Transport::Stream { stream, .. } => {
                let pending = pin!(Transport::exchange(stream, request));
                runtime.wait(py, pending, self.deadline(), &self.closing)
            }
            Transport::Embedded(stream) => {
                let mut pending = pin!(stream.exchange(request));
                match runtime.now(py, || poll_once(pending.as_mut())) {
                    Some(output) => Ok(output),
                    None => runtime.wait(py, pending, self.deadline(), &self.closing),
                }
            }
        };
        match outcome {
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
                // The wait ended before the reply came. If the session continued, the late reply would be taken for the
                // reply to the next request.
                open.close(py);
                Err(explain(broken))
            }
        }
    }
}

impl Drop for PythonSession {
    fn drop(&mut self) {
        if std::process::id() != self.owner {
            // This process was forked, and the session is a copy of the parent's session. Leak it, because its locks
            // may be held forever, and because its connection belongs to the parent.
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

/// A guard of a busy session. When the guard is dropped, also by a panic, it ends the session, so that no session stays
/// busy for ever. If the session continues, the caller passes the guard to [`std::mem::forget`].
pub(super) struct BusyGuard<'a>(pub(super) &'a PythonSession);

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
