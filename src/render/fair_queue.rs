//! A fair queue of pictures (fair queueing, Demers, Keshav and Shenker, 1989). Pictures are drawn in the order in which
//! they would be finished if all waiting pictures were drawn simultaneously, one pixel of each in turn. So a small
//! picture overtakes waiting large ones, but no picture waits for ever.

use std::{
    collections::BTreeMap,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
};

/// Length of the queue at which each `push` first removes the pictures that nobody waits for any more.
const MIN_CLEANUP_LENGTH: usize = 256;

/// A fair queue of entries, each with a number of pixels as its cost. It may be used by several threads.
pub(super) struct FairQueue<T> {
    queue: Mutex<Queue<T>>,
    ready: Condvar,
}

struct Queue<T> {
    /// The entries with their numbers of pixels. The key has the value of `clock` at which the entry is due, then the
    /// number of the entry in the order of arrival.
    waiting: BTreeMap<(u64, u64), (u64, T)>,
    /// The virtual time of fair queueing: the number of pixels of each waiting entry that simultaneous drawing would
    /// have finished by now.
    clock: u64,
    /// The number of entries that were added so far.
    n_pushed: u64,
    closed: bool,
}

impl<T> FairQueue<T> {
    /// Creates an empty queue.
    pub(super) fn new() -> Self {
        let queue = Queue { waiting: BTreeMap::new(), clock: 0, n_pushed: 0, closed: false };
        Self { queue: Mutex::new(queue), ready: Condvar::new() }
    }

    /// Adds an entry that costs this number of pixels. If the queue is long, first removes the entries for which
    /// `is_wanted` returns false.
    pub(super) fn push(&self, pixels: u64, item: T, is_wanted: impl Fn(&T) -> bool) {
        let mut queue = self.lock();
        if queue.waiting.len() >= MIN_CLEANUP_LENGTH {
            queue.waiting.retain(|_, (_, item)| is_wanted(item));
        }
        queue.n_pushed += 1;
        let key = (queue.clock.saturating_add(pixels), queue.n_pushed);
        queue.waiting.insert(key, (pixels, item));
        self.ready.notify_one();
    }

    /// Waits for the next entry and returns it. Returns `None` if the queue is closed.
    pub(super) fn pop(&self) -> Option<T> {
        let mut queue = self.lock();
        loop {
            if queue.closed {
                return None;
            }
            let waiting = queue.waiting.len() as u64;
            if let Some((_, (pixels, item))) = queue.waiting.pop_first() {
                queue.clock = queue.clock.saturating_add(pixels.div_ceil(waiting));
                return Some(item);
            }
            queue = self.ready.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Drops all entries, and makes later calls of `pop` return `None`.
    pub(super) fn close(&self) {
        let mut queue = self.lock();
        queue.closed = true;
        queue.waiting.clear();
        self.ready.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Queue<T>> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order(asked: &[(u64, &'static str)]) -> Vec<&'static str> {
        let queue = FairQueue::new();
        asked.iter().for_each(|&(pixels, name)| queue.push(pixels, name, |_| true));
        asked.iter().map(|_| queue.pop().unwrap()).collect()
    }

    #[test]
    fn small_picture_comes_first_and_equal_ones_in_order() {
        assert_eq!(order(&[(400, "a"), (400, "b"), (400, "c"), (1, "small")]), ["small", "a", "b", "c"]);
    }

    #[test]
    fn small_picture_overtakes_waiting_large_ones() {
        let queue = FairQueue::new();
        (0..40).for_each(|i| queue.push(4000, i, |_| true));
        assert_eq!((queue.pop(), queue.pop()), (Some(0), Some(1)));
        queue.push(4, 99, |_| true);
        assert_eq!((queue.pop(), queue.pop()), (Some(99), Some(2)));
    }

    #[test]
    fn a_large_picture_is_not_passed_for_ever() {
        let queue = FairQueue::new();
        queue.push(100, "large", |_| true);
        let mut small = 0;
        loop {
            queue.push(10, "small", |_| true);
            match queue.pop().unwrap() {
                "large" => break,
                _ => small += 1,
            }
        }
        assert!(small <= 20, "{small} small ones came before it: it has half of what is drawn");
    }

    #[test]
    fn what_nobody_waits_for_goes_and_a_closed_queue_is_empty() {
        let queue = FairQueue::new();
        for i in 0..MIN_CLEANUP_LENGTH + 1 {
            queue.push(1, i, |&item| item >= MIN_CLEANUP_LENGTH - 1);
        }
        assert_eq!(queue.pop(), Some(MIN_CLEANUP_LENGTH - 1));
        queue.close();
        queue.push(1, 0, |_| true);
        assert_eq!(queue.pop(), None);
    }
}
