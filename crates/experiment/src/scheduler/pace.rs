//! How far a training is, whose episodes grow longer or shorter while it learns: the time is that of its steps.

/// The length of an episode is taken from about so many of the last ones, whatever stretches they are told of in: a few
/// say little where lengths differ as much as they are.
const RECENT: f64 = 100.0;
/// So much of all steps must be done before anything is said.
const LEAST: f64 = 0.01;
/// Episodes grow while the last ones are so much longer than all …
const GROWING: f64 = 1.3;
/// … and no more than this share of the budget is done: later, what is left is a good part of what was seen.
const EARLY: f64 = 0.25;

/// What was told of a training, in one process, and what follows from it.
#[derive(Clone, Debug, Default)]
pub struct Pace {
    /// Episodes and steps that were done before, …
    first: Option<(f64, f64)>,
    /// … and episodes and steps by now.
    last: (f64, f64),
    /// Steps of an episode, lately.
    length: Option<f64>,
}

impl Pace {
    /// Takes note of the episodes that there have been, and of their steps; the first time, of those that there were before.
    pub fn hear(&mut self, episodes: f64, steps: u64) {
        let steps = steps as f64;
        if self.first.is_none() {
            self.first = Some((episodes, steps));
        } else if episodes > self.last.0 {
            let stretch = episodes - self.last.0;
            let length = (steps - self.last.1) / stretch;
            let share = (1.0 - (-stretch / RECENT).exp()).max(stretch / (episodes - self.begun()));
            self.length = Some(self.length.map_or(length, |known| known + share * (length - known)));
        } else {
            return; // it counts with the next episode
        }
        self.last = (episodes, steps);
    }

    /// Episodes that were done before.
    pub fn begun(&self) -> f64 {
        self.first.map_or(0.0, |(episodes, _)| episodes)
    }

    /// What is left of `episodes`, in terms of what was done since the beginning: 1 if it is as much. `None` while that
    /// cannot be known.
    pub fn left(&self, episodes: f64) -> Option<f64> {
        let done = self.last.1 - self.first?.1;
        let left = (episodes - self.last.0).max(0.0) * self.length?;
        (done > LEAST * (done + left)).then(|| left / done)
    }

    /// Whether what is left of `episodes` is probably more than [`Pace::left`] says: they grow longer, and few are done.
    pub fn is_least(&self, episodes: f64) -> bool {
        let (Some((_, first)), Some(length)) = (self.first, self.length) else { return false };
        let mean = (self.last.1 - first) / (self.last.0 - self.begun());
        self.last.0 < EARLY * episodes && length > GROWING * mean
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_that_grow_longer_take_longer() {
        let mut pace = Pace::default();
        assert_eq!(pace.left(100.0), None);
        pace.hear(0.0, 0);
        assert_eq!(pace.left(100.0), None, "nothing was done yet");
        pace.hear(10.0, 100);
        assert_eq!(pace.left(100.0), Some(9.0));
        (2..=5).for_each(|i| pace.hear(10.0 * f64::from(i), 100 + 1000 * u64::from(i as u32 - 1)));
        let left = pace.left(100.0).unwrap();
        // 4100 steps were done; the other half of the episodes takes 5000 at the last length, which is known in part.
        assert!((0.9..1.22).contains(&left), "{left}");
        pace.hear(100.0, 9100);
        assert_eq!(pace.left(100.0), Some(0.0));
    }

    #[test]
    fn what_is_left_of_episodes_that_grow_is_the_least_until_a_quarter_is_done() {
        let mut pace = Pace::default();
        pace.hear(0.0, 0);
        assert!(!pace.is_least(4000.0), "nothing is known");
        pace.hear(500.0, 5000);
        assert!(!pace.is_least(4000.0), "all were of a length");
        pace.hear(700.0, 10_000);
        assert!(pace.is_least(4000.0) && !pace.is_least(2000.0));
        pace.hear(900.0, 11_000);
        assert!(!pace.is_least(4000.0), "they grow no more");
    }

    #[test]
    fn a_few_long_episodes_change_little() {
        let mut pace = Pace::default();
        pace.hear(0.0, 0);
        (1..=50).for_each(|i| pace.hear(10.0 * f64::from(i), 1000 * i as u64));
        let before = pace.left(2000.0).unwrap();
        pace.hear(502.0, 50_000 + 2 * 1000);
        let after = pace.left(2000.0).unwrap();
        assert!((before - 3.0).abs() < 1e-9 && (1.0..1.2).contains(&(after / before)), "{before}, then {after}");
        // However stretches are cut, episodes that are twice as long for long enough are believed.
        (1..=200).for_each(|i| pace.hear(502.0 + 2.0 * f64::from(i), 52_000 + 400 * i as u64));
        let length = pace.left(2000.0).unwrap() * 132_000.0 / (2000.0 - 902.0);
        assert!((190.0..=210.0).contains(&length), "{length}");
    }

    #[test]
    fn what_was_done_before_took_no_time_of_this_process() {
        let mut pace = Pace::default();
        pace.hear(50.0, 5000);
        pace.hear(60.0, 6000);
        assert_eq!((pace.left(100.0), pace.begun()), (Some(4.0), 50.0));
    }
}
