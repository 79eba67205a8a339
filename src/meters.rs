//! Counters of steps, episodes and durations. The counters are atomics, so counting needs neither a lock nor an
//! allocation.

use std::{
    array,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

/// The number of bounds of a [`Histogram`]. The first bound is 1 µs, each further bound is twice the previous one, and
/// the last is 8.4 s.
pub const N_BOUNDS: usize = 24;

/// A histogram of durations.
pub struct Histogram {
    /// For each bound, the number of durations up to this bound and above the previous one; finally, the number above
    /// all bounds.
    counts: [AtomicU64; N_BOUNDS + 1],
    nanos: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: array::from_fn(|_| AtomicU64::new(0)), nanos: AtomicU64::new(0) }
    }
}

impl Histogram {
    /// Adds a duration.
    pub fn observe(&self, time: Duration) {
        let nanos = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let place = nanos.div_ceil(1000).max(1).next_power_of_two().trailing_zeros() as usize;
        self.counts[place.min(N_BOUNDS)].fetch_add(1, Ordering::Relaxed);
        self.nanos.fetch_add(nanos, Ordering::Relaxed);
    }

    /// Returns each bound, in s, with the number of durations up to this bound and above the previous one. The last
    /// bound is infinity.
    pub fn counts(&self) -> [(f64, u64); N_BOUNDS + 1] {
        let bound = |place| if place < N_BOUNDS { (1u64 << place) as f64 / 1e6 } else { f64::INFINITY };
        array::from_fn(|place| (bound(place), self.counts[place].load(Ordering::Relaxed)))
    }

    /// Returns the sum of all durations, s.
    pub fn seconds(&self) -> f64 {
        self.nanos.load(Ordering::Relaxed) as f64 / 1e9
    }
}

/// The classes of batch sizes: each class's maximum size and its label in metrics.
const BATCH_SIZE_CLASSES: [(usize, &str); 5] =
    [(1, "1"), (16, "2-16"), (256, "17-256"), (4096, "257-4096"), (usize::MAX, "4097+")];

/// Counters of all environments with the same name.
#[derive(Default)]
pub struct Meter {
    /// The number of steps, summed over the environments.
    pub steps: AtomicU64,
    /// The number of ended episodes.
    pub episodes: AtomicU64,
    times: [Histogram; BATCH_SIZE_CLASSES.len()],
}

impl Meter {
    /// Returns the histogram of step times for batches of `size` environments. A step time runs from the validation of
    /// the request to the reply.
    pub fn times(&self, size: usize) -> &Histogram {
        &self.times[BATCH_SIZE_CLASSES.iter().position(|(greatest, _)| size <= *greatest).unwrap_or_default()]
    }

    /// Returns each class of batch sizes: its label, and the histogram of its step times.
    pub fn classes(&self) -> impl Iterator<Item = (&'static str, &Histogram)> {
        BATCH_SIZE_CLASSES.iter().map(|(_, name)| *name).zip(&self.times)
    }
}

/// The step counter of one batch. Its steps also count in the counters of all environments with the same name.
pub struct Tally {
    /// The counters of all environments with the same name.
    pub meter: Arc<Meter>,
    /// The steps of this batch, summed over its environments.
    steps: AtomicU64,
}

impl Tally {
    /// Makes the counters of a new batch, all 0.
    pub fn new(meter: Arc<Meter>) -> Self {
        Self { meter, steps: AtomicU64::new(0) }
    }

    /// Adds steps and ended episodes of a part of the batch.
    pub fn add(&self, steps: usize, episodes: usize) {
        self.steps.fetch_add(steps as u64, Ordering::Relaxed);
        self.meter.steps.fetch_add(steps as u64, Ordering::Relaxed);
        self.meter.episodes.fetch_add(episodes as u64, Ordering::Relaxed);
    }

    /// Returns the number of the batch's steps so far, summed over its environments.
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
