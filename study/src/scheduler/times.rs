//! How long the cells that are left may take, by what finished ones took.

use std::collections::HashMap;
use std::time::Duration;

use crate::paper::Method;
use crate::plan::Cell;

/// What finished cells took.
#[derive(Debug, Default)]
pub(crate) struct Times<'a> {
    by_pair: HashMap<(&'a str, Method), Mean>,
    all: Mean,
}

#[derive(Clone, Copy, Debug, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, number: f64) {
        self.sum += number;
        self.count += 1.0;
    }

    fn get(self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

impl<'a> Times<'a> {
    pub(crate) fn add(&mut self, cell: &'a Cell, seconds: f64) {
        self.by_pair.entry((&cell.config.common.environment, cell.method())).or_default().add(seconds);
        self.all.add(seconds);
    }

    /// What cells of the same environment and learner took; `None` before the first.
    pub(crate) fn of_pair(&self, cell: &Cell) -> Option<f64> {
        self.by_pair.get(&(cell.config.common.environment.as_str(), cell.method()))?.get()
    }

    /// How many cells there are.
    pub(crate) fn cells(&self) -> usize {
        self.all.count as usize
    }

    /// How long `cells`, which have run for so many seconds each, may still take, so many at a time.
    pub(crate) fn remaining<'c>(
        &self,
        cells: impl Iterator<Item = (&'c Cell, f64)>,
        at_a_time: usize,
    ) -> Option<Duration> {
        let overall = self.all.get()?;
        let (mut seconds, mut longest, mut left) = (0.0, 0.0_f64, 0);
        for (cell, spent) in cells {
            let expected = self.of_pair(cell).unwrap_or(overall);
            let rest = (expected - spent).max(0.0);
            seconds += rest;
            longest = longest.max(rest);
            left += 1;
        }
        let at_a_time = at_a_time.clamp(1, left.max(1)) as f64;
        Some(Duration::from_secs_f64((seconds / at_a_time).max(longest)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;

    const PLAN: &str = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

    #[test]
    fn the_remaining_time_follows_from_cells_of_the_same_kind() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let [cart_pole, cart_pole_2, hopper, hopper_2] = &plan.cells[..] else { panic!() };
        let mut times = Times::default();
        let seconds = |times: &Times<'_>, cells: &[(&Cell, f64)], at_a_time: usize| {
            times.remaining(cells.iter().copied(), at_a_time).map(|time| time.as_secs_f64())
        };
        assert_eq!(seconds(&times, &[(hopper, 0.0)], 1), None);
        times.add(cart_pole, 10.0);
        assert_eq!(seconds(&times, &[(hopper, 0.0)], 1), Some(10.0), "nothing better is known");
        times.add(hopper, 30.0);
        let left = [(cart_pole_2, 4.0), (hopper_2, 0.0)];
        assert_eq!(seconds(&times, &left, 1), Some(36.0));
        assert_eq!(seconds(&times, &left, 2), Some(30.0), "the longest ends last");
        assert_eq!(seconds(&times, &left, 8), Some(30.0));
        assert_eq!(seconds(&times, &[(cart_pole_2, 99.0)], 1), Some(0.0));
    }
}
