//! The limit on the number of environments in a pool.

use super::Error;
use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};
use tokio::sync::Notify;

/// A counter of the environments in use, with a limit.
pub(super) struct Capacity {
    used: AtomicUsize,
    limit: usize,
    /// Notified whenever `used` has changed.
    changed: Notify,
}

impl Capacity {
    /// Makes the counter of a pool that may hold `limit` environments.
    pub(super) fn new(limit: usize) -> Self {
        Self { used: AtomicUsize::new(0), limit, changed: Notify::new() }
    }

    /// The number of environments in use.
    pub(super) fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// The maximum number of environments.
    pub(super) fn limit(&self) -> usize {
        self.limit
    }

    /// Waits until the number of environments in use has changed since the last call. Only one task may wait.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Reserves room for `requested` environments until the permit is dropped.
    pub(super) fn reserve(self: &Arc<Self>, requested: usize) -> Result<Permit, Error> {
        let limit = self.limit;
        let fits = |used: usize| used.checked_add(requested).filter(|&sum| sum <= limit);
        match self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits) {
            Ok(_) => {
                self.changed.notify_one();
                Ok(Permit { capacity: Arc::clone(self), count: AtomicUsize::new(requested) })
            }
            Err(used) => Err(Error::Full { requested, used, limit }),
        }
    }

    fn release(&self, environments: usize) {
        self.used.fetch_sub(environments, Ordering::Relaxed);
        self.changed.notify_one();
    }
}

/// Room for a number of environments in the pool. Dropping it frees the room.
pub(super) struct Permit {
    capacity: Arc<Capacity>,
    count: AtomicUsize,
}

impl Permit {
    /// Frees the room for `count` of the permit's environments. `count` must not exceed their number.
    pub(super) fn release(&self, count: usize) {
        self.count.fetch_sub(count, Ordering::Relaxed);
        self.capacity.release(count);
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.capacity.release(*self.count.get_mut());
    }
}
