//! How long an experiment may still take, by what was done of it while it was looked at: whatever does it, and however
//! many processes or machines.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// What was done is remembered so often …
const INTERVAL: Duration = Duration::from_secs(10);
/// … and for so long.
const MOST: usize = 90;
/// Nothing is said before so much time has passed …
const LEAST_TIME: Duration = Duration::from_secs(10);
/// … and so much of the whole was done in it.
const LEAST_SHARE: f64 = 0.002;

/// What was done at some moments: the share of each cell.
#[derive(Debug, Default)]
pub(crate) struct Pace(VecDeque<(Instant, Vec<f32>)>);

impl Pace {
    /// Takes note of what is done now.
    pub(crate) fn hear(&mut self, now: Instant, shares: &[f32]) {
        // Cells that are begun anew, or another plan: what was before says nothing.
        let other = |then: &[f32]| then.len() != shares.len() || then.iter().zip(shares).any(|(then, now)| now < then);
        if self.0.back().is_some_and(|(_, then)| other(then)) {
            self.0.clear();
        }
        if self.0.back().is_none_or(|(time, _)| now.duration_since(*time) >= INTERVAL) {
            self.0.push_back((now, shares.to_vec()));
            self.0.drain(..self.0.len().saturating_sub(MOST));
        }
    }

    /// Nobody works on it.
    pub(crate) fn forget(&mut self) {
        self.0.clear();
    }

    /// Seconds that are left if it goes on as it did, where a cell takes as long as its `weight` says in terms of others;
    /// `None` while that cannot be known.
    pub(crate) fn left(&self, now: Instant, shares: &[f32], weights: &[f64]) -> Option<f64> {
        let (begun, then) = self.0.front()?;
        let time = now.duration_since(*begun);
        let sum =
            |shares: &[f32]| shares.iter().zip(weights).map(|(share, weight)| f64::from(*share) * weight).sum::<f64>();
        let (all, done) = (weights.iter().sum::<f64>(), sum(shares));
        let new = done - sum(then);
        let known = time >= LEAST_TIME && new >= LEAST_SHARE * all;
        known.then(|| (all - done).max(0.0) / new * time.as_secs_f64())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_follows_from_what_was_done() {
        let (begin, mut pace) = (Instant::now(), Pace::default());
        let at = |seconds| begin + Duration::from_secs(seconds);
        let weights = [10.0, 10.0, 20.0];
        pace.hear(at(0), &[0.5, 0.0, 0.0]);
        assert_eq!(pace.left(at(5), &[0.9, 0.0, 0.0], &weights), None, "too early");
        assert_eq!(pace.left(at(20), &[0.5, 0.0, 0.0], &weights), None, "nothing was done");
        pace.hear(at(20), &[1.0, 0.0, 0.0]);
        // 5 of 40 in 20 s; 30 are left.
        assert_eq!(pace.left(at(20), &[1.0, 0.0, 0.0], &weights), Some(120.0));
        pace.hear(at(40), &[0.0, 0.0, 0.0]);
        let anew = pace.left(at(60), &[0.1, 0.0, 0.0], &weights).unwrap(); // 1 of 40 in 20 s
        assert!((anew - 39.0 / 1.0 * 20.0).abs() < 1e-3, "begun anew: {anew}");
        pace.forget();
        assert_eq!(pace.left(at(60), &[0.2, 0.0, 0.0], &weights), None);
    }
}
