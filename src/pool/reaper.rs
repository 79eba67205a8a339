//! A thread that frees the environments of closed sessions.

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

/// The niceness of the thread. It is low in priority because no request waits for it.
const REAPER_NICENESS: i32 = 3;

/// Frees a closed session's batch, and returns whether it could. It runs on the reaper's thread, because freeing
/// thousands of environments would block the transport's thread for too long.
pub(super) type DeferredDrop = Box<dyn FnMut() -> bool + Send>;
/// The interval at which freeing is retried for a batch that was still in use.
const REAP_INTERVAL: Duration = Duration::from_millis(1);

/// The handle of the thread, until it is closed.
pub(super) struct Reaper {
    drops: Mutex<Option<mpsc::Sender<DeferredDrop>>>,
    /// The number of batches that are not freed yet.
    pending: Arc<AtomicUsize>,
}

impl Reaper {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the operating system starts no thread.
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

    /// Hands a batch to the thread, which frees it.
    pub(super) fn drop_later(&self, deferred: DeferredDrop) {
        if let Some(drops) = &*lock(&self.drops) {
            self.pending.fetch_add(1, Ordering::AcqRel);
            let _ = drops.send(deferred); // its thread ends only with the pool
        }
    }

    /// Waits until all batches that were handed over so far are freed.
    pub(super) async fn idle(&self) {
        while self.pending.load(Ordering::Acquire) > 0 {
            tokio::time::sleep(REAP_INTERVAL).await;
        }
    }

    /// Ends the thread when it has nothing left to free.
    pub(super) fn close(&self) {
        *lock(&self.drops) = None;
    }
}

/// Frees each batch that comes, as soon as it is not in use, until the pool ends.
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
