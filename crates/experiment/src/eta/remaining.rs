//! Estimates the remaining time of an experiment.

use std::collections::HashMap;
use std::time::Duration;

use perturb_settings::Method;

use super::durations::CellDurations;
use crate::plan::Cell;

/// The estimated remaining time of an experiment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RemainingTime {
    /// The estimated time.
    pub time: Duration,
    /// Whether the estimate is an upper bound, because it uses the measured upper bound of at least one cell.
    pub at_most: bool,
}

/// A cell that is running or waiting.
pub(crate) struct UnfinishedCell<'a> {
    pub(crate) cell: &'a Cell,
    /// Seconds since the cell started; `None` if it is waiting.
    pub(crate) elapsed_seconds: Option<f64>,
    /// Remaining work divided by the work since the cell started; `None` if it is not known.
    pub(crate) remaining_ratio: Option<f64>,
    /// Upper bound of the whole cell's process time from a measurement, in seconds; `None` without a measurement.
    pub(crate) max_seconds: Option<f64>,
}

/// Estimates the remaining time of `cells` when `at_a_time` processes run in parallel. If a cell's remaining ratio is
/// not known, its duration is the first known of these: the mean of finished cells with its environment and method, the
/// expected mean of running cells with its environment and method, the measured upper bound. Returns `None` if none of
/// these is known for some cell.
pub(crate) fn remaining_time(
    durations: &CellDurations<'_>,
    cells: &[UnfinishedCell<'_>],
    at_a_time: usize,
) -> Option<RemainingTime> {
    let under_way = cells.iter().filter(|cell| cell.elapsed_seconds.is_some()).count();
    // Cells of one group run in one process and share its time. So the process time of a running cell is its elapsed
    // time, multiplied by the number of processes per running cell (at most 1).
    let share = (at_a_time as f64 / under_way.max(1) as f64).min(1.0);
    let key = |cell: &'_ Cell| (cell.config.common.environment.clone(), cell.method());
    // Sum and number of the expected durations of running cells, by environment and method.
    let mut running: HashMap<(String, Method), (f64, f64)> = HashMap::new();
    for one in cells {
        if let (Some(elapsed), Some(ratio)) = (one.elapsed_seconds, one.remaining_ratio) {
            let (sum, count) = running.entry(key(one.cell)).or_default();
            (*sum, *count) = (*sum + elapsed * share * (1.0 + ratio), *count + 1.0);
        }
    }
    // Adds the remaining process times. The estimate is never below the remaining time of the longest cell.
    let (mut seconds, mut longest, mut at_most) = (0.0, 0.0_f64, false);
    for one in cells {
        let elapsed = one.elapsed_seconds.unwrap_or_default();
        let rest = if let Some(ratio) = one.remaining_ratio {
            elapsed * share * ratio
        } else {
            let of_running = || running.get(&key(one.cell)).map(|(sum, count)| sum / count);
            let expected = durations.seconds(one.cell).or_else(of_running).or_else(|| {
                at_most |= one.max_seconds.is_some();
                one.max_seconds
            });
            (expected? - elapsed * share).max(0.0)
        };
        seconds += rest;
        longest = longest.max(if one.elapsed_seconds.is_some() { rest / share } else { rest });
    }
    let at_a_time = at_a_time.clamp(1, cells.len().max(1)) as f64;
    // With an absurd budget, the time exceeds the maximum of `Duration`.
    let time = Duration::try_from_secs_f64((seconds / at_a_time).max(longest)).unwrap_or(Duration::MAX);
    Some(RemainingTime { time, at_most })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;

    const PLAN: &str = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

    /// A cell; if it is running, also its elapsed seconds and its remaining ratio.
    type OfCell<'a> = (&'a Cell, Option<(f64, Option<f64>)>);

    fn seconds(durations: &CellDurations<'_>, cells: &[OfCell<'_>], at_a_time: usize) -> Option<f64> {
        let left = cells.iter().map(|&(cell, running)| UnfinishedCell {
            cell,
            elapsed_seconds: running.map(|(elapsed, _)| elapsed),
            remaining_ratio: running.and_then(|(_, rest)| rest),
            max_seconds: None,
        });
        remaining_time(durations, &left.collect::<Vec<_>>(), at_a_time).map(|left| left.time.as_secs_f64())
    }

    #[test]
    fn waiting_cells_take_the_mean_of_their_environment_and_method() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let [cart_pole, cart_pole_2, hopper, hopper_2] = &plan.cells[..] else { panic!() };
        let mut times = CellDurations::default();
        assert_eq!(seconds(&times, &[(hopper, None)], 1), None);
        times.add(cart_pole, 10.0);
        assert_eq!(seconds(&times, &[(cart_pole_2, None), (hopper, None)], 1), None, "a Hopper is no CartPole");
        times.add(hopper, 30.0);
        let left = [(cart_pole_2, Some((4.0, None))), (hopper_2, None)];
        assert_eq!(seconds(&times, &left, 1), Some(36.0));
        assert_eq!(seconds(&times, &left, 2), Some(30.0), "the longest ends last");
        assert_eq!(seconds(&times, &left, 8), Some(30.0));
        assert_eq!(seconds(&times, &[(cart_pole_2, Some((99.0, None)))], 1), Some(0.0));
    }

    #[test]
    fn running_cells_predict_waiting_cells_of_same_method() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let [cart_pole, cart_pole_2, hopper, hopper_2] = &plan.cells[..] else { panic!() };
        let times = CellDurations::default();
        // After 20 s the remaining work is twice the work so far.
        let a_third = Some((20.0, Some(2.0)));
        assert_eq!(seconds(&times, &[(hopper, a_third)], 1), Some(40.0));
        assert_eq!(seconds(&times, &[(hopper, a_third), (hopper_2, None)], 1), Some(100.0));
        // Two cells shared one process for 20 s, so each took 10 s for its first third and needs 20 s more.
        assert_eq!(seconds(&times, &[(cart_pole, a_third), (cart_pole_2, a_third)], 1), Some(40.0));
        assert_eq!(seconds(&times, &[(cart_pole, a_third), (cart_pole_2, None), (hopper, None)], 1), None);
    }

    #[test]
    fn measured_maxima_are_used_for_methods_without_begun_cells() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let waits = |max_seconds| UnfinishedCell {
            cell: &plan.cells[3],
            elapsed_seconds: None,
            remaining_ratio: None,
            max_seconds,
        };
        let begun = || UnfinishedCell {
            cell: &plan.cells[0],
            elapsed_seconds: Some(10.0),
            remaining_ratio: Some(1.0),
            max_seconds: Some(9e9),
        };
        let of = |cells: &[UnfinishedCell<'_>]| remaining_time(&CellDurations::default(), cells, 1);
        assert_eq!(of(&[begun()]), Some(RemainingTime { time: Duration::from_secs(10), at_most: false }));
        assert_eq!(of(&[begun(), waits(Some(70.0))]).unwrap().time, Duration::from_secs(80));
        assert!(of(&[begun(), waits(Some(70.0))]).unwrap().at_most);
        assert_eq!(of(&[begun(), waits(None)]), None);
        assert_eq!(of(&[begun(), waits(Some(1e300))]).unwrap().time, Duration::MAX, "of absurd budgets");
    }
}
