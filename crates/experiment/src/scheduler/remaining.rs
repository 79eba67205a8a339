//! How long a run may still take: cells under way say how far they are, those that are done what others of their kind
//! take, and of kinds that have not begun a measurement says the most.

use std::collections::HashMap;
use std::time::Duration;

use perturb_settings::Method;

use crate::plan::Cell;
use crate::times::Times;

/// How long a run may still take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Remaining {
    /// About.
    pub time: Duration,
    /// Whether some of it is only known not to be more.
    pub at_most: bool,
}

/// A cell that is not done.
pub(super) struct Left<'a> {
    pub(super) cell: &'a Cell,
    /// For how long it has been under way, s; `None` if it waits.
    pub(super) elapsed: Option<f64>,
    /// What is left of it, in terms of what was done in that time; `None` if it cannot be told.
    pub(super) rest: Option<f64>,
    /// What it may take at most, s of a process, if anybody knows.
    pub(super) most: Option<f64>,
}

/// How long the cells of `left` may take, so many at a time; `None` if of one of them nothing is known.
pub(super) fn remaining(times: &Times<'_>, left: &[Left<'_>], at_a_time: usize) -> Option<Remaining> {
    let under_way = left.iter().filter(|cell| cell.elapsed.is_some()).count();
    // The time of a process is shared by the cells that it does together.
    let share = (at_a_time as f64 / under_way.max(1) as f64).min(1.0);
    let kind = |cell: &'_ Cell| (cell.config.common.environment.clone(), cell.method());
    let mut running: HashMap<(String, Method), (f64, f64)> = HashMap::new();
    for one in left {
        if let (Some(elapsed), Some(rest)) = (one.elapsed, one.rest) {
            let (sum, count) = running.entry(kind(one.cell)).or_default();
            (*sum, *count) = (*sum + elapsed * share * (1.0 + rest), *count + 1.0);
        }
    }
    let (mut seconds, mut longest, mut at_most) = (0.0, 0.0_f64, false);
    for one in left {
        let elapsed = one.elapsed.unwrap_or_default();
        let rest = if let Some(rest) = one.rest {
            elapsed * share * rest
        } else {
            let of_running = || running.get(&kind(one.cell)).map(|(sum, count)| sum / count);
            let expected = times.of_pair(one.cell).or_else(of_running).or_else(|| {
                at_most |= one.most.is_some();
                one.most
            });
            (expected? - elapsed * share).max(0.0)
        };
        seconds += rest;
        longest = longest.max(if one.elapsed.is_some() { rest / share } else { rest });
    }
    let at_a_time = at_a_time.clamp(1, left.len().max(1)) as f64;
    Some(Remaining { time: Duration::from_secs_f64((seconds / at_a_time).max(longest)), at_most })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Plan;

    const PLAN: &str = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

    /// A cell that waits, or has been under way for so long with so much left.
    type OfCell<'a> = (&'a Cell, Option<(f64, Option<f64>)>);

    fn seconds(times: &Times<'_>, cells: &[OfCell<'_>], at_a_time: usize) -> Option<f64> {
        let left = cells.iter().map(|&(cell, running)| Left {
            cell,
            elapsed: running.map(|(elapsed, _)| elapsed),
            rest: running.and_then(|(_, rest)| rest),
            most: None,
        });
        remaining(times, &left.collect::<Vec<_>>(), at_a_time).map(|left| left.time.as_secs_f64())
    }

    #[test]
    fn what_is_left_follows_from_cells_of_the_same_kind() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let [cart_pole, cart_pole_2, hopper, hopper_2] = &plan.cells[..] else { panic!() };
        let mut times = Times::default();
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
    fn a_cell_under_way_says_what_it_and_others_of_its_kind_take() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let [cart_pole, cart_pole_2, hopper, hopper_2] = &plan.cells[..] else { panic!() };
        let times = Times::default();
        let a_third = Some((20.0, Some(2.0)));
        assert_eq!(seconds(&times, &[(hopper, a_third)], 1), Some(40.0));
        assert_eq!(seconds(&times, &[(hopper, a_third), (hopper_2, None)], 1), Some(100.0));
        // Two in one process had half of it each.
        assert_eq!(seconds(&times, &[(cart_pole, a_third), (cart_pole_2, a_third)], 1), Some(40.0));
        assert_eq!(seconds(&times, &[(cart_pole, a_third), (cart_pole_2, None), (hopper, None)], 1), None);
    }

    #[test]
    fn of_a_kind_that_has_not_begun_the_most_is_known() {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let waits = |most| Left { cell: &plan.cells[3], elapsed: None, rest: None, most };
        let begun = || Left { cell: &plan.cells[0], elapsed: Some(10.0), rest: Some(1.0), most: Some(9e9) };
        let of = |cells: &[Left<'_>]| remaining(&Times::default(), cells, 1);
        assert_eq!(of(&[begun()]), Some(Remaining { time: Duration::from_secs(10), at_most: false }));
        assert_eq!(of(&[begun(), waits(Some(70.0))]).unwrap().time, Duration::from_secs(80));
        assert!(of(&[begun(), waits(Some(70.0))]).unwrap().at_most);
        assert_eq!(of(&[begun(), waits(None)]), None);
    }
}
