//! The order in which pictures are drawn: turns by pixels. Each is due when it would be finished if all that wait were drawn
//! at once, pixel by pixel in turn: fair queueing, Demers, Keshav and Shenker (1989). So a small one comes before large ones
//! that wait, however many they are, and nobody is passed for ever.

use std::{
    collections::BTreeMap,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
};

/// So many that wait are looked through for those that nobody waits for any more.
const MANY: usize = 256;

/// What waits for its turn.
pub(super) struct Turns<T> {
    queue: Mutex<Queue<T>>,
    ready: Condvar,
}

struct Queue<T> {
    /// By when each is due, and the order in which they came; with its pixels.
    waiting: BTreeMap<(u64, u64), (u64, T)>,
    /// Pixels that one which waits all the time would have had of those that were drawn.
    clock: u64,
    came: u64,
    closed: bool,
}

impl<T> Turns<T> {
    /// Nothing waits.
    pub(super) fn new() -> Self {
        let queue = Queue { waiting: BTreeMap::new(), clock: 0, came: 0, closed: false };
        Self { queue: Mutex::new(queue), ready: Condvar::new() }
    }

    /// Adds what takes so many pixels. What is not `wanted` any more goes, where many wait.
    pub(super) fn push(&self, pixels: u64, item: T, wanted: impl Fn(&T) -> bool) {
        let mut queue = self.lock();
        if queue.waiting.len() >= MANY {
            queue.waiting.retain(|_, (_, item)| wanted(item));
        }
        queue.came += 1;
        let turn = (queue.clock.saturating_add(pixels), queue.came);
        queue.waiting.insert(turn, (pixels, item));
        self.ready.notify_one();
    }

    /// The next, for which it waits; none once it is closed.
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

    /// Drops what waits, and has nothing wait any more.
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
        let turns = Turns::new();
        asked.iter().for_each(|&(pixels, name)| turns.push(pixels, name, |_| true));
        asked.iter().map(|_| turns.pop().unwrap()).collect()
    }

    #[test]
    fn a_small_picture_comes_before_large_ones_and_equal_ones_in_their_order() {
        assert_eq!(order(&[(400, "a"), (400, "b"), (400, "c"), (1, "small")]), ["small", "a", "b", "c"]);
    }

    #[test]
    fn a_small_picture_does_not_wait_for_large_ones_that_came_before_it_while_the_first_is_drawn() {
        let turns = Turns::new();
        (0..40).for_each(|i| turns.push(4000, i, |_| true));
        assert_eq!((turns.pop(), turns.pop()), (Some(0), Some(1)));
        turns.push(4, 99, |_| true);
        assert_eq!((turns.pop(), turns.pop()), (Some(99), Some(2)));
    }

    #[test]
    fn a_large_picture_is_not_passed_for_ever() {
        let turns = Turns::new();
        turns.push(100, "large", |_| true);
        let mut small = 0;
        loop {
            turns.push(10, "small", |_| true);
            match turns.pop().unwrap() {
                "large" => break,
                _ => small += 1,
            }
        }
        assert!(small <= 20, "{small} small ones came before it: it has half of what is drawn");
    }

    #[test]
    fn what_nobody_waits_for_goes_and_a_closed_queue_is_empty() {
        let turns = Turns::new();
        for i in 0..MANY + 1 {
            turns.push(1, i, |&item| item >= MANY - 1);
        }
        assert_eq!(turns.pop(), Some(MANY - 1));
        turns.close();
        turns.push(1, 0, |_| true);
        assert_eq!(turns.pop(), None);
    }
}
