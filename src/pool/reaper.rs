//! The thread that frees the environments of closed sessions, and environments that a session has released.

use super::sync::lock;
use crate::priority::lower;
use perturb_system::explain_no_thread;
use std::{
    io,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
        mpsc::{self, RecvTimeoutError},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

/// The niceness of the thread. The thread's priority is low, because no request waits for it.
const REAPER_NICENESS: i32 = 3;

/// A function that frees environments unless a worker still uses them, and returns whether they are freed. The reaper's
/// thread calls it, because freeing thousands of environments would block the transport thread for too long.
pub(super) type DeferredDrop = Box<dyn FnMut() -> bool + Send>;
/// The interval at which freeing a batch that was still in use is retried.
const REAP_INTERVAL: Duration = Duration::from_millis(1);

/// The handle to the reaper's thread.
pub(super) struct Reaper {
    drops: Mutex<Option<mpsc::Sender<DeferredDrop>>>,
    /// The number of [`DeferredDrop`]s whose environments have not been freed yet.
    pending: Arc<AtomicUsize>,
}

impl Reaper {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the operating system cannot start a thread.
    pub(super) fn start() -> io::Result<(Self, JoinHandle<()>)> {
        let (drops, received) = mpsc::channel::<DeferredDrop>();
        let pending = Arc::<AtomicUsize>::default();
        let counted = Arc::clone(&pending);
        let freeing = move || {
            lower(REAPER_NICENESS);
            reap(&received, &counted);
        };
        let thread =
            thread::Builder::new().name("free".into()).spawn(freeing).map_err(|error| explain_no_thread(&error))?;
        Ok((Self { drops: Mutex::new(Some(drops)), pending }, thread))
    }

    /// Queues environments to be freed by the thread.
    pub(super) fn drop_later(&self, deferred: DeferredDrop) {
        if let Some(drops) = &*lock(&self.drops) {
            self.pending.fetch_add(1, Ordering::AcqRel);
            let _ = drops.send(deferred); // cannot fail: the thread runs as long as this sender exists
        }
    }

    /// Waits until the thread has freed all queued environments.
    pub(super) async fn idle(&self) {
        while self.pending.load(Ordering::Acquire) > 0 {
            tokio::time::sleep(REAP_INTERVAL).await;
        }
    }

    /// Ends the thread. A batch that is closed later is freed by the thread that drops it.
    pub(super) fn close(&self) {
        *lock(&self.drops) = None;
    }
}

/// Frees queued environments as soon as they are not in use, until the sender is dropped.
fn reap(received: &mpsc::Receiver<DeferredDrop>, pending: &AtomicUsize) {
    let mut left: Vec<DeferredDrop> = Vec::new();
    loop {
        let next = match left.is_empty() {
            true => received.recv().map_err(|_| RecvTimeoutError::Disconnected),
            false => received.recv_timeout(REAP_INTERVAL),
        };
        match next {
            Ok(deferred) => left.push(deferred),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        left.retain_mut(|deferred| {
            let is_freed = deferred();
            if is_freed {
                pending.fetch_sub(1, Ordering::AcqRel);
            }
            !is_freed
        });
    }
}
