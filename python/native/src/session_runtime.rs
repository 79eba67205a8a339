//! The async runtime of a session's connection. The thread that waits for a reply runs it. A separate thread for the
//! connection would have to pass each reply on, which takes longer than a step.

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

/// Interval at which a waiting thread calls Python's signal handlers. Python itself calls them only between two Python
/// instructions.
const SIGNAL_CHECK_INTERVAL: Duration = Duration::from_millis(20);
/// Number of times that a thread yields to the connection's tasks, so that they write pending messages. A message
/// passes through several tasks before it is written.
const POLL_YIELDS: usize = 4;

/// Maximum number of runtimes. Up to this number, each session has its own runtime, so that sessions in different
/// threads do not wait for each other. Further sessions share runtimes, because a runtime needs four file descriptors.
const MAX_RUNTIMES: usize = 16;

/// A future that a thread waits for.
pub type Pending<'a, T> = Pin<&'a mut (dyn Future<Output = T> + Send + 'a)>;

/// The reason why a wait ended before its future was ready.
pub enum WaitError {
    /// A signal's handler raised an error, for example `KeyboardInterrupt` after Ctrl-C.
    Interrupted(PyErr),
    /// The deadline passed.
    TimedOut,
    /// Another thread closed the session.
    Closed,
}

/// A flag with which one thread closes a session while another thread waits for the session's reply.
#[derive(Default)]
pub struct CloseSignal {
    closed: AtomicBool,
    notify: Notify,
}

impl CloseSignal {
    /// Ends the present wait, or the next one if no thread waits.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.notify.notify_waiters();
        self.notify.notify_one();
    }

    /// Whether the session was closed.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }
}

/// A tokio runtime, on which a waiting thread runs the tasks of connections.
struct Reactor {
    /// `None` only while the reactor is dropped.
    runtime: Option<Runtime>,
    /// The process that made the runtime.
    owner: u32,
}

/// The runtimes that further sessions may share. After a fork, the list also has runtimes of the parent process, which
/// [`Reactor::find`] ignores.
static REACTORS: Mutex<Vec<Weak<Reactor>>> = Mutex::new(Vec::new());

impl Reactor {
    fn new() -> io::Result<Arc<Self>> {
        let runtime = Builder::new_current_thread().enable_io().enable_time().build()?;
        Ok(Arc::new(Self { runtime: Some(runtime), owner: std::process::id() }))
    }

    /// Returns a new runtime, or the one with the fewest sessions if there are [`MAX_RUNTIMES`].
    fn find() -> io::Result<Arc<Self>> {
        // Do not wait for the lock, but make a separate runtime. In a forked process the lock may stay held for ever,
        // because the fork did not copy the thread that held it.
        let Ok(mut reactors) = REACTORS.try_lock() else { return Self::new() };
        let own = std::process::id();
        let used: Vec<_> = reactors.iter().filter_map(Weak::upgrade).filter(|reactor| reactor.owner == own).collect();
        if used.len() >= MAX_RUNTIMES
            && let Some(least_used) = used.iter().min_by_key(|reactor| Arc::strong_count(reactor))
        {
            return Ok(Arc::clone(least_used));
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
            runtime.shutdown_background(); // does not wait for a running DNS lookup
        } else {
            // A forked process shares its parent's epoll instance. If it dropped the runtime, the parent's connection
            // would be removed from that instance.
            std::mem::forget(runtime);
        }
    }
}

/// The runtime with which a session waits for replies.
pub struct SessionRuntime {
    reactor: Arc<Reactor>,
}

impl SessionRuntime {
    /// Returns a runtime of this process.
    ///
    /// # Errors
    /// If the system has no more file descriptors.
    pub fn new() -> io::Result<Self> {
        Ok(Self { reactor: Reactor::find()? })
    }

    /// Waits for a future until the deadline. The GIL is released during the wait, except for signal checks.
    ///
    /// # Errors
    /// [`WaitError`] if the wait ended before the future was ready.
    pub fn wait<T: Send>(
        &self,
        py: Python<'_>,
        mut pending: Pending<'_, T>,
        deadline: Option<Instant>,
        closing: &Arc<CloseSignal>,
    ) -> Result<T, WaitError> {
        let Some(runtime) = self.reactor.runtime.as_ref() else { return Err(WaitError::Closed) };
        loop {
            let wait = match deadline {
                Some(deadline) => SIGNAL_CHECK_INTERVAL.min(deadline.saturating_duration_since(Instant::now())),
                None => SIGNAL_CHECK_INTERVAL,
            };
            let output = py.detach(|| {
                runtime.block_on(async {
                    tokio::select! {
                        biased;
                        output = &mut pending => Some(output),
                        () = closing.notify.notified() => None,
                        () = tokio::time::sleep(wait) => None,
                    }
                })
            });
            match output {
                Some(output) => return Ok(output),
                None if closing.is_closed() => return Err(WaitError::Closed),
                None => py.check_signals().map_err(WaitError::Interrupted)?,
            }
            if deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                return Err(WaitError::TimedOut);
            }
        }
    }

    /// Calls a function on this thread without the GIL. The function must not block. It runs in the context of the
    /// runtime, so it may spawn tasks.
    pub fn now<T: Send>(&self, py: Python<'_>, work: impl FnOnce() -> T + Send) -> T {
        py.detach(|| {
            let _context = self.reactor.runtime.as_ref().map(Runtime::enter);
            work()
        })
    }

    /// Lets the connection write pending messages and answer the server's keepalive pings. The caller must not hold the
    /// GIL.
    pub fn poll_io(&self) {
        if let Some(runtime) = &self.reactor.runtime {
            runtime.block_on(async {
                for _ in 0..POLL_YIELDS {
                    yield_now().await;
                }
            });
        }
    }
}
