//! The progress of one training, and an estimate of its remaining work.
//!
//! The time of a training is proportional to its number of steps, but its budget is a number of episodes. Episodes
//! become longer or shorter while the policy learns, so the remaining steps are estimated from the length of recent
//! episodes.

/// Number of recent episodes over which the episode length is averaged. An average over fewer episodes would vary too
/// much.
const RECENT_EPISODES: f64 = 100.0;
/// Minimum share (0 to 1) of this process's steps, done and remaining, that must be done before the remaining steps are
/// estimated.
const MIN_SHARE: f64 = 0.01;
/// Episodes count as growing if the mean length of recent episodes is more than this factor times the mean length of
/// all episodes of this process.
const GROWTH_FACTOR: f64 = 1.3;
/// Share of the budget (0 to 1) up to which growing episodes make the estimate a lower bound.
const EARLY_SHARE: f64 = 0.25;

/// The progress of one training, as far as this process has run it.
#[derive(Clone, Debug, Default)]
pub struct TrainingProgress {
    /// Numbers of episodes and steps when this process started; `None` before the first update.
    first: Option<(f64, f64)>,
    /// Numbers of episodes and steps at the last update that added an episode.
    last: (f64, f64),
    /// Mean length of recent episodes, in steps; `None` before the first episode.
    length: Option<f64>,
}

impl TrainingProgress {
    /// Sets the total numbers of episodes and steps so far. The first call must pass the numbers at the start of this
    /// process.
    pub fn update(&mut self, episodes: f64, steps: u64) {
        let steps = steps as f64;
        if self.first.is_none() {
            self.first = Some((episodes, steps));
        } else if episodes > self.last.0 {
            let new = episodes - self.last.0;
            let length = (steps - self.last.1) / new;
            let share = (1.0 - (-new / RECENT_EPISODES).exp()).max(new / (episodes - self.first_episodes()));
            self.length = Some(self.length.map_or(length, |known| known + share * (length - known)));
        } else {
            return; // no episode has ended; these steps are counted when the next one ends
        }
        self.last = (episodes, steps);
    }

    /// Returns the number of episodes that earlier processes did before this process started.
    pub fn first_episodes(&self) -> f64 {
        self.first.map_or(0.0, |(episodes, _)| episodes)
    }

    /// Returns the estimated remaining steps divided by the steps that this process has done. `episodes` is the budget
    /// of the training. Returns `None` before there is enough progress.
    pub fn remaining_ratio(&self, episodes: f64) -> Option<f64> {
        let done = self.last.1 - self.first?.1;
        let left = (episodes - self.last.0).max(0.0) * self.length?;
        (done > MIN_SHARE * (done + left)).then(|| left / done)
    }

    /// Returns whether [`TrainingProgress::remaining_ratio`] is probably too low. This is the case early in a training
    /// if its episodes are becoming longer.
    pub fn is_lower_bound(&self, episodes: f64) -> bool {
        let (Some((_, first)), Some(length)) = (self.first, self.length) else { return false };
        let mean = (self.last.1 - first) / (self.last.0 - self.first_episodes());
        self.last.0 < EARLY_SHARE * episodes && length > GROWTH_FACTOR * mean
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_that_grow_longer_take_longer() {
        let mut progress = TrainingProgress::default();
        assert_eq!(progress.remaining_ratio(100.0), None);
        progress.update(0.0, 0);
        assert_eq!(progress.remaining_ratio(100.0), None, "nothing was done yet");
        progress.update(10.0, 100);
        assert_eq!(progress.remaining_ratio(100.0), Some(9.0));
        (2..=5).for_each(|i| progress.update(10.0 * f64::from(i), 100 + 1000 * u64::from(i as u32 - 1)));
        let left = progress.remaining_ratio(100.0).unwrap();
        // 4100 steps are done. The other half would take 5000 steps at the last length, but the average has not fully
        // reached this length.
        assert!((0.9..1.22).contains(&left), "{left}");
        progress.update(100.0, 9100);
        assert_eq!(progress.remaining_ratio(100.0), Some(0.0));
    }

    #[test]
    fn growing_episodes_give_a_lower_bound_early_in_the_training() {
        let mut progress = TrainingProgress::default();
        progress.update(0.0, 0);
        assert!(!progress.is_lower_bound(4000.0), "nothing is known");
        progress.update(500.0, 5000);
        assert!(!progress.is_lower_bound(4000.0), "all were of a length");
        progress.update(700.0, 10_000);
        assert!(progress.is_lower_bound(4000.0) && !progress.is_lower_bound(2000.0));
        progress.update(900.0, 11_000);
        assert!(!progress.is_lower_bound(4000.0), "they grow no more");
    }

    #[test]
    fn a_few_long_episodes_change_little() {
        let mut progress = TrainingProgress::default();
        progress.update(0.0, 0);
        (1..=50).for_each(|i| progress.update(10.0 * f64::from(i), 1000 * i as u64));
        let before = progress.remaining_ratio(2000.0).unwrap();
        progress.update(502.0, 50_000 + 2 * 1000);
        let after = progress.remaining_ratio(2000.0).unwrap();
        assert!((before - 3.0).abs() < 1e-9 && (1.0..1.2).contains(&(after / before)), "{before}, then {after}");
        // Later episodes have 200 steps, twice the former length. The average reaches 200, although every update adds
        // only two episodes.
        (1..=200).for_each(|i| progress.update(502.0 + 2.0 * f64::from(i), 52_000 + 400 * i as u64));
        let length = progress.remaining_ratio(2000.0).unwrap() * 132_000.0 / (2000.0 - 902.0);
        assert!((190.0..=210.0).contains(&length), "{length}");
    }

    #[test]
    fn episodes_before_this_process_do_not_count() {
        let mut progress = TrainingProgress::default();
        progress.update(50.0, 5000);
        progress.update(60.0, 6000);
        assert_eq!((progress.remaining_ratio(100.0), progress.first_episodes()), (Some(4.0), 50.0));
    }
}
