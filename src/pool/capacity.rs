//! The pool's budget of environments.

use super::Error;
use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};
use tokio::sync::Notify;

/// The number of environments in use, with its limit.
pub(super) struct Capacity {
    used: AtomicUsize,
    limit: usize,
    /// Notified whenever `used` has changed.
    changed: Notify,
}

impl Capacity {
    /// A budget of at most `limit` environments.
    pub(super) fn new(limit: usize) -> Self {
        Self { used: AtomicUsize::new(0), limit, changed: Notify::new() }
    }

    /// Environments in use.
    pub(super) fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// The maximum number of environments.
    pub(super) fn limit(&self) -> usize {
        self.limit
    }

    /// Waits until the number of environments in use has changed since the last call, for one caller.
    pub(super) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Takes `requested` environments out of the budget until the permit is dropped.
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

/// A part of the pool's budget of environments.
pub(super) struct Permit {
    capacity: Arc<Capacity>,
    count: AtomicUsize,
}

impl Permit {
    /// Returns environments of the permit to the budget, at most as many as it has.
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
