//! The connection under a session. No thread of its own drives it, but whoever waits for a reply: to hand one over to
//! another thread and back costs more than a step.

use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use pyo3::prelude::*;
use tokio::runtime::{Builder, Runtime};
use tokio::sync::Notify;
use tokio::task::yield_now;

/// How often a waiting thread looks for signals, which Python answers between two of its instructions.
const SLICE: Duration = Duration::from_millis(20);
/// So often the connection gets a turn to write what a request, or a session's end, has for it: a task takes it up, and
/// another one sends it.
const TURNS: usize = 4;

/// Sessions have a runtime of their own, so that threads with a session each do not wait for each other; beyond so many
/// they share, since each takes four file descriptors.
const MOST_RUNTIMES: usize = 16;

/// Something to wait for, which owns what it needs.
pub type Pending<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// Why a wait ended without what it was for.
pub enum Broken {
    /// Python's: Ctrl-C, or what another signal's handler raised.
    Interrupted(PyErr),
    /// It took too long.
    Overdue,
    /// Another thread closed the session.
    Closed,
}

/// A session's end, which another thread may bring about.
#[derive(Default)]
pub struct Closing {
    closed: AtomicBool,
    told: Notify,
}

impl Closing {
    /// Ends the wait that there is, or the next.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.told.notify_waiters();
        self.told.notify_one();
    }

    /// Whether it has come.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }
}

/// What runs connections' tasks while somebody waits.
struct Reactor {
    /// Empty once this is dropped.
    runtime: Option<Runtime>,
    /// The process that made it.
    owner: u32,
}

/// Those that are in use.
static REACTORS: Mutex<Vec<Weak<Reactor>>> = Mutex::new(Vec::new());

impl Reactor {
    fn new() -> io::Result<Arc<Self>> {
        let runtime = Builder::new_current_thread().enable_io().enable_time().build()?;
        Ok(Arc::new(Self { runtime: Some(runtime), owner: std::process::id() }))
    }

    /// One for another session.
    fn find() -> io::Result<Arc<Self>> {
        // In a forked process it may be locked for ever.
        let Ok(mut reactors) = REACTORS.try_lock() else { return Self::new() };
        let own = std::process::id();
        let used: Vec<_> = reactors.iter().filter_map(Weak::upgrade).filter(|reactor| reactor.owner == own).collect();
        if used.len() >= MOST_RUNTIMES
            && let Some(least) = used.iter().min_by_key(|reactor| Arc::strong_count(reactor))
        {
            return Ok(Arc::clone(least));
        }
        let reactor = Self::new()?;
        *reactors = used.iter().chain([&reactor]).map(Arc::downgrade).collect();
        Ok(reactor)
    }
}

impl Drop for Reactor {
    fn drop(&mut self) {
        let Some(runtime) = self.runtime.take() else { return };
        if std::process::id() == self.owner {
            runtime.shutdown_background(); // a name that is still being looked up is not waited for
        } else {
            // A forked process shares the parent's poll: to leave it would take the parent's connection out of it.
            std::mem::forget(runtime);
        }
    }
}

/// Where a session waits.
pub struct Line {
    reactor: Arc<Reactor>,
}

impl Line {
    /// A line of this process.
    ///
    /// # Errors
    /// If the system has no more file descriptors.
    pub fn new() -> io::Result<Self> {
        Ok(Self { reactor: Reactor::find()? })
    }

    /// Waits, at most until the deadline, without Python's lock but for a look for signals now and then.
    ///
    /// # Errors
    /// [`Broken`]; what was waited for is gone then.
    pub fn wait<T: Send>(
        &self,
        py: Python<'_>,
        mut pending: Pending<T>,
        deadline: Option<Instant>,
        closing: &Arc<Closing>,
    ) -> Result<T, Broken> {
        let Some(runtime) = self.reactor.runtime.as_ref() else { return Err(Broken::Closed) };
        loop {
            let slice = match deadline {
                Some(deadline) => SLICE.min(deadline.saturating_duration_since(Instant::now())),
                None => SLICE,
            };
            let come = py.detach(|| {
                runtime.block_on(async {
                    tokio::select! {
                        biased;
                        come = &mut pending => Some(come),
                        () = closing.told.notified() => None,
                        () = tokio::time::sleep(slice) => None,
                    }
                })
            });
            match come {
                Some(come) => return Ok(come),
                None if closing.is_closed() => return Err(Broken::Closed),
                None => py.check_signals().map_err(Broken::Interrupted)?,
            }
            if deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                return Err(Broken::Overdue);
            }
        }
    }

    /// Lets the connection write what it has, and answer the server's questions whether this side lives. Not for who
    /// has Python's lock.
    pub fn tend(&self) {
        if let Some(runtime) = &self.reactor.runtime {
            runtime.block_on(async {
                for _ in 0..TURNS {
                    yield_now().await;
                }
            });
        }
    }
}
