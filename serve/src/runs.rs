//! The states of runs, which are kept in memory between requests.

use std::path::Path;
use std::sync::{Arc, Mutex};

use crate::assessment::LiveAssessment;
use crate::experiment::LiveExperiment;
use crate::keyed_cache::KeyedCache;
use crate::training::LiveTraining;

/// The states of all runs that pages have shown in the last ten minutes.
#[derive(Debug, Default)]
pub(crate) struct Runs {
    pub(crate) trainings: RunCache<LiveTraining>,
    pub(crate) experiments: RunCache<LiveExperiment>,
    pub(crate) assessments: RunCache<LiveAssessment>,
}

/// The states of runs of one kind, by folder. Each state has its own lock, so that a slow run does not delay others.
#[derive(Debug)]
pub(crate) struct RunCache<T>(KeyedCache<Box<Path>, Arc<Mutex<T>>>);

impl Runs {
    /// Drops the states that were not used in the last ten minutes.
    pub(crate) fn remove_idle(&self) {
        self.trainings.0.remove_idle(|_| false);
        self.experiments.0.remove_idle(|_| false);
        self.assessments.0.remove_idle(|_| false);
    }
}

impl<T> Default for RunCache<T> {
    fn default() -> Self {
        Self(KeyedCache::default())
    }
}

impl<T> RunCache<T> {
    /// Calls `with` for the state of the run in `folder`, and returns its result. Calls `new` first if the state is not
    /// in the cache.
    pub(crate) fn with<R>(&self, folder: &Path, new: impl Fn() -> T, with: impl FnOnce(&mut T) -> R) -> R {
        let run = self.0.get_or_insert_with(folder.into(), || Arc::new(Mutex::new(new())));
        let mut guard = run.lock().unwrap_or_else(|poisoned| {
            // The thread that held the lock has panicked, so the state may be inconsistent. It is replaced by a new
            // one.
            let mut guard = poisoned.into_inner();
            *guard = new();
            run.clear_poison();
            guard
        });
        with(&mut guard)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_locked_run_delays_no_other_run() {
        let (cache, [a, b]) = (RunCache::<u8>::default(), ["a", "b"].map(Path::new));
        cache.with(
            a,
            || 1,
            |run| {
                *run = 2;
                assert_eq!(cache.with(b, || 3, |other| *other), 3);
            },
        );
        assert_eq!(cache.with(a, || 1, |run| *run), 2);
    }

    #[test]
    fn a_run_is_made_again_after_a_panic() {
        let cache = RunCache::<u8>::default();
        let a = Path::new("a");
        let panics = std::panic::AssertUnwindSafe(|| {
            cache.with(
                a,
                || 1,
                |run| {
                    *run = 2;
                    panic!("as intended");
                },
            );
        });
        assert!(std::panic::catch_unwind(panics).is_err());
        assert_eq!(cache.with(a, || 1, |run| *run), 1);
        assert_eq!(cache.with(a, || 3, |run| *run), 1);
    }
}
