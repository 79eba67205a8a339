//! From the results of cells to the paper's numbers.
//!
//! Per environment, method, training version and run, one configuration is selected: the one with the highest success
//! rate when tested on the version that it was trained on. Of equal ones the one with the higher mean return in the same
//! test is taken, of still equal ones the one that the plan lists first; so is it where that version was not tested. Like
//! in the paper, the test that selects is the test that is reported; with a large grid that makes Default and
//! Interpolation look a little better than they are.

use std::collections::BTreeMap;

use super::folder::{CellResult, CellState, Failure, Folder, FolderError};
use super::plan::{Cell, Method, Plan};
use super::statistics::{Iqm, Summary};
use crate::{Rates, Scenario, Version, mean};

/// What is known of a plan's cells.
#[derive(Debug)]
pub struct Results<'a> {
    /// The plan.
    pub plan: &'a Plan,
    /// By the cells' indices.
    pub states: Vec<CellState>,
}

/// One of the paper's three numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Metric {
    /// The success rate of DD.
    Default,
    /// The success rate of RR.
    Interpolation,
    /// The geometric mean of the success rates of DR, DE and RE.
    Extrapolation,
}

impl Metric {
    /// All, in the paper's order.
    pub const ALL: [Metric; 3] = [Metric::Default, Metric::Interpolation, Metric::Extrapolation];
}

impl std::fmt::Display for Metric {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Metric::Default => "Default",
            Metric::Interpolation => "Interpolation",
            Metric::Extrapolation => "Extrapolation",
        })
    }
}

/// A row of the paper's tables: an environment and a method.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// The environment.
    pub environment: String,
    /// What learned.
    pub method: Method,
    /// Cells that the plan has for it.
    pub cells: usize,
    /// Of these, cells with a result. If some are missing, selection was among fewer than the plan asks for.
    pub done: usize,
    /// What was selected in each run, by its number from 1.
    pub runs: BTreeMap<u32, Selected>,
}

/// What was selected in a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Selected {
    /// The index of the cell, by training version; `None` if no result is there to select.
    pub cells: [Option<usize>; 3],
    /// Success rates, %, by training and testing version; `None` where nothing was tested.
    pub rates: [[Option<f64>; 3]; 3],
}

impl<'a> Results<'a> {
    /// Reads all cells of `plan` in `folder`.
    ///
    /// # Errors
    /// [`FolderError`] if a file is there that cannot be read.
    pub fn read(plan: &'a Plan, folder: &Folder) -> Result<Self, FolderError> {
        let states = plan.cells.iter().map(|cell| folder.state(cell)).collect::<Result<_, _>>()?;
        Ok(Self { plan, states })
    }

    /// The result of a cell.
    pub fn result(&self, index: usize) -> Option<&CellResult> {
        match &self.states[index] {
            CellState::Done(result) => Some(result),
            _ => None,
        }
    }

    /// How many cells have a result.
    pub fn done(&self) -> usize {
        self.states.iter().filter(|state| matches!(state, CellState::Done(_))).count()
    }

    /// The failures.
    pub fn failures(&self) -> impl Iterator<Item = &Failure> {
        self.states.iter().filter_map(|state| match state {
            CellState::Failed(failure) => Some(failure),
            _ => None,
        })
    }

    /// Selects; one group for each environment and method of the plan, in its order.
    pub fn select(&self) -> Vec<Group> {
        let mut groups: Vec<Group> = Vec::new();
        for cell in &self.plan.cells {
            let (environment, method) = (&cell.config.common.environment, cell.method());
            let known = groups.iter_mut().find(|group| group.environment == *environment && group.method == method);
            let group = match known {
                Some(group) => group,
                None => {
                    groups.push(Group {
                        environment: environment.clone(),
                        method,
                        cells: 0,
                        done: 0,
                        runs: BTreeMap::new(),
                    });
                    groups.last_mut().unwrap_or_else(|| unreachable!("one was just added"))
                }
            };
            self.consider(cell, group);
        }
        groups
    }

    /// Takes `cell` into account, which comes after all cells that the plan lists before it.
    fn consider(&self, cell: &Cell, group: &mut Group) {
        group.cells += 1;
        let selected = group.runs.entry(cell.run).or_default();
        let Some(result) = self.result(cell.index) else { return };
        group.done += 1;
        let version = cell.config.common.version;
        let best = &mut selected.cells[version as usize];
        let rank = |index: usize| {
            let test = self.result(index)?.results.get(&version)?;
            Some((test.success_percent, test.mean_return))
        };
        if best.is_none_or(|best| rank(cell.index) > rank(best)) {
            *best = Some(cell.index);
            let rate = |tested: Version| result.results.get(&tested).map(|test| test.success_percent);
            selected.rates[version as usize] = Version::ALL.map(rate);
        }
    }
}

impl Selected {
    /// The success rate of a scenario, %.
    pub fn rate(&self, scenario: Scenario) -> Option<f64> {
        self.rates[scenario.train as usize][scenario.test as usize]
    }

    /// A metric, %; `None` if one of the scenarios that it is made of is missing.
    pub fn metric(&self, metric: Metric) -> Option<f64> {
        use Version::{D, E, R};
        let needed: &[(Version, Version)] = match metric {
            Metric::Default => &[(D, D)],
            Metric::Interpolation => &[(R, R)],
            Metric::Extrapolation => &[(D, R), (D, E), (R, E)],
        };
        if needed.iter().any(|&(train, test)| self.rate(Scenario { train, test }).is_none()) {
            return None;
        }
        // What is missing now is not looked at.
        let rates = Rates(self.rates.map(|row| row.map(|rate| rate.unwrap_or(f64::NAN)))).metrics();
        Some(match metric {
            Metric::Default => rates.default,
            Metric::Interpolation => rates.interpolation,
            Metric::Extrapolation => rates.extrapolation,
        })
    }
}

impl Group {
    /// A metric of each run that has it, %, by the run's number.
    pub fn metric(&self, metric: Metric) -> BTreeMap<u32, f64> {
        self.runs.iter().filter_map(|(&run, selected)| Some((run, selected.metric(metric)?))).collect()
    }

    /// Mean and deviation over runs, %.
    pub fn summary(&self, metric: Metric) -> Option<Summary> {
        Summary::of(&self.metric(metric).into_values().collect::<Vec<_>>())
    }

    /// A scenario's success rate over runs, %.
    pub fn scenario(&self, scenario: Scenario) -> Option<Summary> {
        Summary::of(&self.runs.values().filter_map(|selected| selected.rate(scenario)).collect::<Vec<_>>())
    }
}

/// A metric averaged over the environments of `groups`, in each run that all of them have; mean and deviation over
/// these runs.
pub fn average(groups: &[&Group], metric: Metric) -> Option<Summary> {
    let runs = common_runs(groups, metric);
    Summary::of(&runs.into_iter().map(|numbers| mean(numbers.into_iter())).collect::<Vec<_>>())
}

/// The interquartile mean of a metric over the environments of `groups` and the runs that all of them have, with its
/// bootstrap interval and the number of these runs.
pub fn interquartile(groups: &[&Group], metric: Metric, resamples: usize) -> Option<(Iqm, usize)> {
    let runs = common_runs(groups, metric);
    let strata: Vec<Vec<f64>> = (0..groups.len()).map(|i| runs.iter().map(|numbers| numbers[i]).collect()).collect();
    Some((Iqm::of(&strata, resamples, 1)?, runs.len()))
}

/// For each run that all `groups` have, the metric in each of them.
fn common_runs(groups: &[&Group], metric: Metric) -> Vec<Vec<f64>> {
    let by_environment: Vec<BTreeMap<u32, f64>> = groups.iter().map(|group| group.metric(metric)).collect();
    let of_run = |run: &u32| by_environment.iter().map(|runs| runs.get(run).copied()).collect();
    by_environment.first().map_or_else(Vec::new, |first| first.keys().filter_map(of_run).collect())
}

#[cfg(test)]
#[path = "selection_tests.rs"]
mod tests;
