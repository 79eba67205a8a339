//! Estimates the remaining time of an experiment from its progress while its page is open.
//!
//! The estimate uses only the progress in the experiment's files, so it works for local processes, Slurm jobs and
//! several machines.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Time between two samples of the progress.
const SAMPLE_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum number of stored samples.
const MAX_SAMPLES: usize = 90;
/// Minimum time between the first sample and an estimate.
const MIN_TIME: Duration = Duration::from_secs(10);
/// Minimum share of the whole experiment that must be done between the first sample and an estimate.
const MIN_SHARE: f64 = 0.002;

/// Samples of the progress. A sample has its time and the finished share of each cell, 0 to 1.
#[derive(Debug, Default)]
pub(crate) struct Eta(VecDeque<(Instant, Vec<f32>)>);

impl Eta {
    /// Adds a sample if the last one is old enough.
    pub(crate) fn sample(&mut self, now: Instant, shares: &[f32]) {
        // If a share has decreased or the number of cells differs, cells were started again or the plan has changed.
        // Earlier samples are then useless.
        let differs =
            |then: &[f32]| then.len() != shares.len() || then.iter().zip(shares).any(|(then, now)| now < then);
        if self.0.back().is_some_and(|(_, then)| differs(then)) {
            self.0.clear();
        }
        if self.0.back().is_none_or(|(time, _)| now.duration_since(*time) >= SAMPLE_INTERVAL) {
            self.0.push_back((now, shares.to_vec()));
            self.0.drain(..self.0.len().saturating_sub(MAX_SAMPLES));
        }
    }

    /// Drops all samples. Call it while the experiment is not running.
    pub(crate) fn reset(&mut self) {
        self.0.clear();
    }

    /// Returns the remaining time in seconds, at the speed since the oldest stored sample. `shares` has the finished
    /// share of each cell, and `weights` the durations of the cells relative to each other. Returns `None` before there
    /// is enough progress.
    pub(crate) fn remaining_seconds(&self, now: Instant, shares: &[f32], weights: &[f64]) -> Option<f64> {
        let (start, then) = self.0.front()?;
        let time = now.duration_since(*start);
        let sum =
            |shares: &[f32]| shares.iter().zip(weights).map(|(share, weight)| f64::from(*share) * weight).sum::<f64>();
        let all = weights.iter().sum::<f64>();
        let done = sum(shares);
        let new = done - sum(then);
        let known = time >= MIN_TIME && new >= MIN_SHARE * all;
        known.then(|| (all - done).max(0.0) / new * time.as_secs_f64())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_remaining_time_follows_from_the_progress() {
        let begin = Instant::now();
        let mut eta = Eta::default();
        let at = |seconds| begin + Duration::from_secs(seconds);
        let weights = [10.0, 10.0, 20.0];
        eta.sample(at(0), &[0.5, 0.0, 0.0]);
        assert_eq!(eta.remaining_seconds(at(5), &[0.9, 0.0, 0.0], &weights), None, "too early");
        assert_eq!(eta.remaining_seconds(at(20), &[0.5, 0.0, 0.0], &weights), None, "nothing was done");
        eta.sample(at(20), &[1.0, 0.0, 0.0]);
        // The weights sum to 40. At the first sample 5 were done, and 5 more in the next 20 s, so 30 remain.
        assert_eq!(eta.remaining_seconds(at(20), &[1.0, 0.0, 0.0], &weights), Some(120.0));
        eta.sample(at(40), &[0.0, 0.0, 0.0]);
        let anew = eta.remaining_seconds(at(60), &[0.1, 0.0, 0.0], &weights).unwrap(); // 1 of 40 in 20 s
        assert!((anew - 39.0 / 1.0 * 20.0).abs() < 1e-3, "begun anew: {anew}");
        eta.reset();
        assert_eq!(eta.remaining_seconds(at(60), &[0.2, 0.0, 0.0], &weights), None);
    }
}
