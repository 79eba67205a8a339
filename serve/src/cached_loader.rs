//! A cached value that is loaded again on demand, by one task at a time and with pauses between loads.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::{Mutex, Semaphore};

/// Minimum pause between two loads of a value.
pub(crate) const MIN_PAUSE: Duration = Duration::from_secs(1);
/// Pause between two loads, as a multiple of the time that the last load took.
pub(crate) const PAUSE_FACTOR: u32 = 5;
/// Maximum time for which a caller waits for a load.
const LOAD_TIMEOUT: Duration = Duration::from_secs(20);

/// A cached value. [`get`](Self::get) loads it again if the pause since the last load is over. Clones share the value.
#[derive(Debug)]
pub(crate) struct CachedLoader<T> {
    last: Arc<Mutex<Option<LoadedValue<T>>>>,
    /// Whether the running load has already taken longer than callers wait for it.
    is_overdue: Arc<AtomicBool>,
}

/// Result of the last load.
#[derive(Debug)]
struct LoadedValue<T> {
    value: Result<T, CachedLoadError>,
    /// Time at which the load ended.
    at: Instant,
    duration: Duration,
}

/// The reason why there is no value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CachedLoadError {
    /// The loading function has panicked, which is a bug in this program.
    Panicked,
    /// The load takes too long, for example because a file system does not answer.
    TimedOut,
}

/// Returns the pause after a load that took `duration`.
pub(crate) fn pause_after(duration: Duration) -> Duration {
    MIN_PAUSE.max(duration * PAUSE_FACTOR)
}

impl<T> Default for CachedLoader<T> {
    fn default() -> Self {
        Self { last: Arc::new(Mutex::new(None)), is_overdue: Arc::default() }
    }
}

impl<T> Clone for CachedLoader<T> {
    fn clone(&self) -> Self {
        Self { last: Arc::clone(&self.last), is_overdue: Arc::clone(&self.is_overdue) }
    }
}

impl<T: Clone + Send + 'static> CachedLoader<T> {
    /// Tells whether a load is under way.
    pub(crate) fn is_loading(&self) -> bool {
        self.last.try_lock().is_err()
    }

    /// Returns the last value if the pause since its load is not over. Otherwise waits for one of `permits`, calls
    /// `load`, and returns the new value.
    ///
    /// A load continues even if no caller waits for it any more. It releases its permit when it ends, or after
    /// [`LOAD_TIMEOUT`] if it takes longer.
    pub(crate) async fn get(
        &self,
        permits: &Arc<Semaphore>,
        load: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, CachedLoadError> {
        self.get_within(LOAD_TIMEOUT, permits, load).await
    }

    /// Implements [`get`](Self::get) with another timeout.
    async fn get_within(
        &self,
        timeout: Duration,
        permits: &Arc<Semaphore>,
        load: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, CachedLoadError> {
        if self.is_overdue.load(Ordering::Relaxed) {
            return Err(CachedLoadError::TimedOut);
        }
        let last = Arc::clone(&self.last);
        let is_overdue = Arc::clone(&self.is_overdue);
        let permits = Arc::clone(permits);
        // The lock makes other callers wait for a running load, whose value they then get.
        let task = tokio::spawn(async move {
            let mut last = last.lock_owned().await;
            if let Some(last) = last.as_ref().filter(|last| last.at.elapsed() < pause_after(last.duration)) {
                return last.value.clone();
            }
            // This cannot fail, because the semaphore is never closed.
            let permit = permits.acquire_owned().await;
            let start = Instant::now();
            let mut load = tokio::task::spawn_blocking(load);
            let loaded = match tokio::time::timeout(timeout, &mut load).await {
                Ok(loaded) => loaded,
                Err(_) => {
                    drop(permit);
                    is_overdue.store(true, Ordering::Relaxed);
                    let loaded = load.await;
                    is_overdue.store(false, Ordering::Relaxed);
                    loaded
                }
            };
            let value = loaded.map_err(|error| {
                tracing::error!("loading a page failed: {error}");
                CachedLoadError::Panicked
            });
            *last = Some(LoadedValue { value: value.clone(), at: Instant::now(), duration: start.elapsed() });
            value
        });
        match tokio::time::timeout(timeout, task).await {
            Ok(value) => value.unwrap_or(Err(CachedLoadError::Panicked)),
            Err(_) => Err(CachedLoadError::TimedOut),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn permits() -> Arc<Semaphore> {
        Arc::new(Semaphore::new(2))
    }

    #[tokio::test]
    async fn many_callers_cause_one_load_and_a_pause() {
        let loads = Arc::new(AtomicUsize::new(0));
        let loader = CachedLoader::default();
        let permits = permits();
        let get = || {
            let loads = Arc::clone(&loads);
            loader.get(&permits, move || {
                std::thread::sleep(Duration::from_millis(300));
                loads.fetch_add(1, Ordering::SeqCst)
            })
        };
        let start = Instant::now();
        let (one, other) = tokio::join!(get(), get());
        assert_eq!((one, other), (Ok(0), Ok(0)));
        while get().await == Ok(0) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        assert!(start.elapsed() >= Duration::from_millis(1800), "the pause is five times the load");
        assert_eq!(get().await, Ok(1));
    }

    #[tokio::test]
    async fn a_panic_is_an_error_until_the_next_load() {
        let broken = CachedLoader::<u8>::default();
        let whole = CachedLoader::default();
        let permits = permits();
        for _ in 0..5 {
            assert_eq!(broken.get(&permits, || panic!("as intended")).await, Err(CachedLoadError::Panicked));
        }
        assert_eq!(whole.get(&permits, || 7).await, Ok(7));
        assert_eq!(
            broken.get(&permits, || 8).await,
            Err(CachedLoadError::Panicked),
            "there is a pause after a panic, too"
        );
        // The pause may last some time, because it depends on the duration of the load. Printing the panic's backtrace
        // counts as a part of the load.
        while broken.get(&permits, || 8).await == Err(CachedLoadError::Panicked) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        assert_eq!(broken.get(&permits, || 8).await, Ok(8));
    }

    #[tokio::test]
    async fn callers_of_an_overdue_load_get_an_error() {
        let (overdue, other, permits) =
            (CachedLoader::<u8>::default(), CachedLoader::default(), Arc::new(Semaphore::new(1)));
        let (end, ended) = std::sync::mpsc::channel::<()>();
        let value = overdue.get_within(Duration::from_millis(100), &permits, move || {
            let _ = ended.recv();
            1
        });
        assert_eq!(value.await, Err(CachedLoadError::TimedOut));
        assert!(overdue.is_loading() && !other.is_loading());
        assert_eq!(other.get(&permits, || 2).await, Ok(2), "the permit is free again");
        assert_eq!(overdue.get(&permits, || 3).await, Err(CachedLoadError::TimedOut), "later callers do not wait");
        drop(end);
        while overdue.get(&permits, || 3).await == Err(CachedLoadError::TimedOut) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(overdue.get(&permits, || 3).await, Ok(1), "the overdue load's value is kept");
    }
}
