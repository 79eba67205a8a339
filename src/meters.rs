//! What is counted on the way of a step: atomics, so that counting takes neither a lock nor memory.

use std::{
    array,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

/// The number of bounds of a [`Histogram`]: 1 µs, and each twice the one before, up to 8.4 s.
pub const N_BOUNDS: usize = 24;

/// How long something took, how often.
pub struct Histogram {
    /// For each bound those that took at most so long and longer than the bound before; at last the longer ones.
    counts: [AtomicU64; N_BOUNDS + 1],
    nanos: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: array::from_fn(|_| AtomicU64::new(0)), nanos: AtomicU64::new(0) }
    }
}

impl Histogram {
    /// Adds one that took so long.
    pub fn observe(&self, time: Duration) {
        let nanos = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let place = nanos.div_ceil(1000).max(1).next_power_of_two().trailing_zeros() as usize;
        self.counts[place.min(N_BOUNDS)].fetch_add(1, Ordering::Relaxed);
        self.nanos.fetch_add(nanos, Ordering::Relaxed);
    }

    /// For each bound, in s, and at last for infinity, how many there are up to it and beyond the one before.
    pub fn counts(&self) -> [(f64, u64); N_BOUNDS + 1] {
        let bound = |place| if place < N_BOUNDS { (1u64 << place) as f64 / 1e6 } else { f64::INFINITY };
        array::from_fn(|place| (bound(place), self.counts[place].load(Ordering::Relaxed)))
    }

    /// The sum of all times, s.
    pub fn seconds(&self) -> f64 {
        self.nanos.load(Ordering::Relaxed) as f64 / 1e9
    }
}

/// The classes of batch sizes: the maximum size of each, and its label in metrics.
const BATCH_SIZE_CLASSES: [(usize, &str); 5] =
    [(1, "1"), (16, "2-16"), (256, "17-256"), (4096, "257-4096"), (usize::MAX, "4097+")];

/// What happens in the environments of one kind.
#[derive(Default)]
pub struct Meter {
    /// Steps of an environment.
    pub steps: AtomicU64,
    /// Episodes that ended.
    pub episodes: AtomicU64,
    times: [Histogram; BATCH_SIZE_CLASSES.len()],
}

impl Meter {
    /// How long a step of a batch of this size takes: of all its environments, from the request's check to its reply.
    pub fn times(&self, size: usize) -> &Histogram {
        &self.times[BATCH_SIZE_CLASSES.iter().position(|(greatest, _)| size <= *greatest).unwrap_or_default()]
    }

    /// The same for each class of sizes.
    pub fn classes(&self) -> impl Iterator<Item = (&'static str, &Histogram)> {
        BATCH_SIZE_CLASSES.iter().map(|(_, name)| *name).zip(&self.times)
    }
}

/// What happens in a batch, counted for it and for its kind of environment.
pub struct Tally {
    /// That of its kind.
    pub meter: Arc<Meter>,
    /// Its own.
    steps: AtomicU64,
}

impl Tally {
    /// Of a batch in which nothing has happened.
    pub fn new(meter: Arc<Meter>) -> Self {
        Self { meter, steps: AtomicU64::new(0) }
    }

    /// Adds what a part of the batch did.
    pub fn add(&self, steps: usize, episodes: usize) {
        self.steps.fetch_add(steps as u64, Ordering::Relaxed);
        self.meter.steps.fetch_add(steps as u64, Ordering::Relaxed);
        self.meter.episodes.fetch_add(episodes as u64, Ordering::Relaxed);
    }

    /// Steps of an environment so far.
    pub fn steps(&self) -> u64 {
        self.steps.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_counted_at_the_least_bound_that_it_does_not_exceed() {
        for (nanos, bound) in [
            (0, 1e-6),
            (1000, 1e-6),
            (1001, 2e-6),
            (2000, 2e-6),
            (2001, 4e-6),
            (8_388_608_000, 8.388608),
            (8_388_608_001, f64::INFINITY),
            (u64::MAX, f64::INFINITY),
        ] {
            let histogram = Histogram::default();
            histogram.observe(Duration::from_nanos(nanos));
            let counted = histogram.counts().into_iter().find(|(_, count)| *count > 0).unwrap();
            assert_eq!(counted, (bound, 1), "{nanos} ns");
            assert_eq!(histogram.seconds(), nanos as f64 / 1e9);
        }
    }

    #[test]
    fn sizes_of_batches_are_in_the_class_that_has_them() {
        let meter = Meter::default();
        for (size, class) in [(1, "1"), (2, "2-16"), (16, "2-16"), (17, "17-256"), (4096, "257-4096"), (4097, "4097+")]
        {
            let same = |(_, times): &(&str, &Histogram)| std::ptr::eq(*times, meter.times(size));
            assert_eq!(meter.classes().find(same).map(|(name, _)| name), Some(class), "{size}");
        }
    }
}
