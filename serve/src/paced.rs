//! Looking at something no more often than a part of the time, by one at a time, for all who want to know.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::{Mutex, Semaphore};

/// Files are looked at so often …
pub(crate) const INTERVAL: Duration = Duration::from_secs(1);
/// … but no more than this share of the time, as one in so many.
pub(crate) const REST: u32 = 5;
/// So long somebody waits for a look.
const PATIENCE: Duration = Duration::from_secs(20);

/// Something that is looked at now and then.
#[derive(Debug)]
pub(crate) struct Paced<T> {
    last: Arc<Mutex<Option<Last<T>>>>,
    /// Whether a look goes on for longer than anybody waits.
    stuck: Arc<AtomicBool>,
}

/// What was seen of it, when, and how long looking took.
#[derive(Debug)]
struct Last<T> {
    seen: Result<T, Trouble>,
    at: Instant,
    took: Duration,
}

/// Why nothing is seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Trouble {
    /// The program is wrong: what looks has panicked.
    Panicked,
    /// Looking takes too long: a file system does not answer, for instance.
    Slow,
}

/// How long after a look that took so long there is no other.
pub(crate) fn rest(took: Duration) -> Duration {
    INTERVAL.max(took * REST)
}

impl<T> Default for Paced<T> {
    fn default() -> Self {
        Self { last: Arc::new(Mutex::new(None)), stuck: Arc::default() }
    }
}

impl<T> Clone for Paced<T> {
    fn clone(&self) -> Self {
        Self { last: Arc::clone(&self.last), stuck: Arc::clone(&self.stuck) }
    }
}

impl<T: Clone + Send + 'static> Paced<T> {
    /// Whether somebody looks just now.
    pub(crate) fn is_busy(&self) -> bool {
        self.last.try_lock().is_err()
    }

    /// What is seen: by a look, as soon as there is `room` for one, or by the last one if it was lately. A look goes on to
    /// its end, also if nobody waits for it any more, but then takes no room from others.
    pub(crate) async fn see(
        &self,
        room: &Arc<Semaphore>,
        look: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Trouble> {
        self.see_within(PATIENCE, room, look).await
    }

    async fn see_within(
        &self,
        patience: Duration,
        room: &Arc<Semaphore>,
        look: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Trouble> {
        if self.stuck.load(Ordering::Relaxed) {
            return Err(Trouble::Slow);
        }
        let (last, stuck, room) = (Arc::clone(&self.last), Arc::clone(&self.stuck), Arc::clone(room));
        let looking = tokio::spawn(async move {
            let mut last = last.lock_owned().await;
            if let Some(known) = last.as_ref().filter(|known| known.at.elapsed() < rest(known.took)) {
                return known.seen.clone();
            }
            let room = room.acquire_owned().await; // nobody closes it
            let begun = Instant::now();
            let mut look = tokio::task::spawn_blocking(look);
            let looked = match tokio::time::timeout(patience, &mut look).await {
                Ok(looked) => looked,
                Err(_) => {
                    drop(room);
                    stuck.store(true, Ordering::Relaxed);
                    let looked = look.await;
                    stuck.store(false, Ordering::Relaxed);
                    looked
                }
            };
            let seen = looked.map_err(|error| {
                tracing::error!("the files were not looked at: {error}");
                Trouble::Panicked
            });
            *last = Some(Last { seen: seen.clone(), at: Instant::now(), took: begun.elapsed() });
            seen
        });
        match tokio::time::timeout(patience, looking).await {
            Ok(seen) => seen.unwrap_or(Err(Trouble::Panicked)),
            Err(_) => Err(Trouble::Slow),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    fn room() -> Arc<Semaphore> {
        Arc::new(Semaphore::new(2))
    }

    #[tokio::test]
    async fn however_many_ask_it_is_looked_once_in_a_while() {
        let (looks, paced, room) = (Arc::new(AtomicUsize::new(0)), Paced::default(), room());
        let see = || {
            let looks = Arc::clone(&looks);
            paced.see(&room, move || {
                std::thread::sleep(Duration::from_millis(300));
                looks.fetch_add(1, Ordering::SeqCst)
            })
        };
        let begun = Instant::now();
        let (one, other) = tokio::join!(see(), see());
        assert_eq!((one, other), (Ok(0), Ok(0)));
        while see().await == Ok(0) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        assert!(begun.elapsed() >= Duration::from_millis(1800), "a rest of five times as long as it took");
        assert_eq!(see().await, Ok(1));
    }

    #[tokio::test]
    async fn a_look_that_panics_harms_no_other() {
        let (broken, whole, room) = (Paced::<u8>::default(), Paced::default(), room());
        for _ in 0..5 {
            assert_eq!(broken.see(&room, || panic!("as intended")).await, Err(Trouble::Panicked));
        }
        assert_eq!(whole.see(&room, || 7).await, Ok(7));
        assert_eq!(broken.see(&room, || 8).await, Err(Trouble::Panicked), "it has a rest, too");
        // As long as its look took: a panic's trace may take a while.
        while broken.see(&room, || 8).await == Err(Trouble::Panicked) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        assert_eq!(broken.see(&room, || 8).await, Ok(8));
    }

    #[tokio::test]
    async fn who_waits_for_a_look_that_does_not_end_is_told() {
        let (stuck, other, room) = (Paced::<u8>::default(), Paced::default(), Arc::new(Semaphore::new(1)));
        let (end, ended) = std::sync::mpsc::channel::<()>();
        let seen = stuck.see_within(Duration::from_millis(100), &room, move || {
            let _ = ended.recv();
            1
        });
        assert_eq!(seen.await, Err(Trouble::Slow));
        assert!(stuck.is_busy() && !other.is_busy());
        assert_eq!(other.see(&room, || 2).await, Ok(2), "there was room for one");
        assert_eq!(stuck.see(&room, || 3).await, Err(Trouble::Slow), "nobody else waits");
        drop(end);
        while stuck.see(&room, || 3).await == Err(Trouble::Slow) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(stuck.see(&room, || 3).await, Ok(1), "what it saw in the end");
    }
}
