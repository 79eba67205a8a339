//! From the results of cells to the paper's numbers.
//!
//! By the clean rule, what is reported are the cells that were trained anew ([`tuned`](super::tuned) says how they are
//! selected). By the paper's rule every cell may be: per environment, method, training version and run, one configuration is selected: the one with the highest success
//! rate when tested on the version that it was trained on. Of equal ones the one with the higher mean return in the same
//! test is taken, of still equal ones the one that the plan lists first; so is it where that version was not tested. Like
//! in the paper, the test that selects is the test that is reported; with a large grid that makes Default and
//! Interpolation look a little better than they are.

use std::collections::BTreeMap;

use perturb_protocol::Version;
use perturb_records::statistics::{Bootstrapped, Summary, interquartile_mean, mean};
use perturb_records::{Assessed, AssessedPolicy, Metric, Scenario, TestResult, TrainedOn};
use perturb_settings::Method;

use crate::folder::{CellResult, CellState, Failure, Folder, FolderError};
use crate::plan::{Cell, Plan, Selection};
use crate::tuning::{Tuned, tuned};

/// What is known of a plan's cells.
#[derive(Debug)]
pub struct Results<'a> {
    /// What was asked for.
    pub plan: &'a Plan,
    /// By the cells' indices.
    pub states: Vec<CellState>,
}

/// What was selected for a row of the paper's tables, which is a method in an environment.
#[derive(Clone, Debug, PartialEq)]
pub struct MethodResults<'a> {
    /// The environment's name.
    pub environment: &'a str,
    /// What was trained.
    pub method: Method,
    /// Cells that the plan has for it, also those that it will have, without those that are trained on its own sets.
    pub cells: usize,
    /// Of these, cells with a result. If some are missing, selection was among fewer than the plan asks for.
    pub done: usize,
    /// By the runs' numbers, from 1.
    pub runs: BTreeMap<u32, SelectedRun<'a>>,
}

/// What is reported of a run, by all that the plan trains on; `None` where nothing has a result yet.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SelectedRun<'a>(pub BTreeMap<TrainedOn<'a>, Option<Reported<'a>>>);

/// A policy whose tests are reported.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reported<'a> {
    /// Of a cell that was selected.
    Cell(Selected<'a>),
    /// Of an agent that was trained elsewhere.
    Elsewhere(&'a Assessed, &'a AssessedPolicy),
}

/// A cell that was selected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Selected<'a> {
    /// What the plan says of it.
    pub cell: &'a Cell,
    /// What it came to.
    pub result: &'a CellResult,
}

impl<'a> Results<'a> {
    /// Reads all cells of `plan`, see [`Plan::in_folder`], in `folder`.
    ///
    /// # Errors
    /// [`FolderError`] if a file is there that cannot be read.
    pub fn read(plan: &'a Plan, folder: &Folder) -> Result<Self, FolderError> {
        let states = plan.cells.iter().map(|cell| folder.state(cell)).collect::<Result<_, _>>()?;
        Ok(Self { plan, states })
    }

    /// The results that there are, in the plan's order.
    pub fn done(&self) -> impl Iterator<Item = &CellResult> {
        self.states.iter().filter_map(|state| match state {
            CellState::Done(result) => Some(&**result),
            _ => None,
        })
    }

    /// The failures, in the plan's order.
    pub fn failures(&self) -> impl Iterator<Item = &Failure> {
        self.states.iter().filter_map(|state| match state {
            CellState::Failed(failure) => Some(failure),
            _ => None,
        })
    }

    /// What tuning cells select.
    pub fn tuned(&self) -> Vec<Tuned<'_>> {
        tuned(self.plan, &self.states)
    }

    /// Selects for each environment and method of the plan, in its order.
    pub fn select(&self) -> Vec<MethodResults<'_>> {
        let mut selections: Vec<MethodResults<'_>> = Vec::new();
        for (cell, state) in self.plan.cells.iter().zip(&self.states) {
            let (environment, method) = (cell.config.common.environment.as_str(), cell.method());
            let known = selections.iter().position(|known| known.environment == environment && known.method == method);
            let place = known.unwrap_or_else(|| {
                selections.push(MethodResults { environment, method, cells: 0, done: 0, runs: BTreeMap::new() });
                selections.len() - 1
            });
            match self.plan.selection {
                Selection::Clean if cell.tuned_as.is_none() => selections[place].tune(cell, state, self.plan.runs),
                Selection::Clean => selections[place].consider(cell, state),
                Selection::Paper => {
                    selections[place].cells += usize::from(cell.set.is_none());
                    selections[place].consider(cell, state);
                }
            }
        }
        selections
    }
}

impl<'a> MethodResults<'a> {
    /// Counts a tuning cell; the first one that is trained on something, also those that are trained on it anew.
    fn tune(&mut self, cell: &'a Cell, state: &'a CellState, runs: u32) {
        let is_papers = usize::from(cell.set.is_none());
        self.cells += is_papers;
        self.done += is_papers * usize::from(matches!(state, CellState::Done(_)));
        for run in 1..=runs {
            self.runs.entry(run).or_default().0.entry(cell.trained_on()).or_insert_with(|| {
                self.cells += is_papers;
                None
            });
        }
    }

    /// Takes `cell` into account, which comes after all cells that the plan lists before it.
    fn consider(&mut self, cell: &'a Cell, state: &'a CellState) {
        let is_papers = usize::from(cell.set.is_none());
        let best = self.runs.entry(cell.run).or_default().0.entry(cell.trained_on()).or_default();
        let CellState::Done(result) = state else { return };
        self.done += is_papers;
        let candidate = Selected { cell, result };
        if best.and_then(|best| best.cell()).is_none_or(|best| candidate.rank() > best.rank()) {
            *best = Some(Reported::Cell(candidate));
        }
    }

    /// A metric of each run that has it, %, by the run's number.
    pub fn metric(&self, metric: Metric) -> BTreeMap<u32, f64> {
        let of_run =
            |(&number, run): (&u32, &SelectedRun<'_>)| Some((number, metric.of(|scenario| run.rate(scenario))?));
        self.runs.iter().filter_map(of_run).collect()
    }

    /// A metric's mean and deviation over runs, %.
    pub fn summary(&self, metric: Metric) -> Option<Summary> {
        Summary::of(&self.metric(metric).into_values().collect::<Vec<_>>())
    }

    /// A scenario's success rate over runs, %.
    pub fn scenario(&self, Scenario { train, test }: Scenario) -> Option<Summary> {
        self.test(TrainedOn::Version(train), &test.to_string(), |test| test.success_percent)
    }

    /// A figure of the tests on a set or version, over runs.
    pub fn test(&self, trained_on: TrainedOn<'_>, tested_on: &str, figure: fn(&TestResult) -> f64) -> Option<Summary> {
        let of_run = |run: &SelectedRun<'_>| run.trained_on(trained_on)?.test(tested_on).map(figure);
        Summary::of(&self.runs.values().filter_map(of_run).collect::<Vec<_>>())
    }
}

impl<'a> SelectedRun<'a> {
    /// What was trained on this.
    pub fn trained_on(&self, trained_on: TrainedOn<'_>) -> Option<Reported<'a>> {
        self.0.get(&trained_on).copied().flatten()
    }

    /// The cell that was trained on this; `None` of an agent that was trained elsewhere.
    pub fn cell_trained_on(&self, trained_on: TrainedOn<'_>) -> Option<Selected<'a>> {
        self.trained_on(trained_on)?.cell()
    }

    /// The success rate of a scenario, %; `None` if nothing was tested there.
    pub fn rate(&self, Scenario { train, test }: Scenario) -> Option<f64> {
        self.trained_on(TrainedOn::Version(train))?.rate(test)
    }
}

impl<'a> Reported<'a> {
    /// The cell; `None` of an agent that was trained elsewhere.
    pub fn cell(&self) -> Option<Selected<'a>> {
        match self {
            Self::Cell(selected) => Some(*selected),
            Self::Elsewhere(..) => None,
        }
    }

    /// The figures of its test on a set or version; `None` if it was not tested there.
    pub fn test(&self, tested_on: &str) -> Option<&'a TestResult> {
        match self {
            Self::Cell(selected) => selected.test(tested_on),
            Self::Elsewhere(_, policy) => policy.test(tested_on),
        }
    }

    /// The success rate on `version`, %; `None` if it was not tested there.
    pub fn rate(&self, version: Version) -> Option<f64> {
        Some(self.test(&version.to_string())?.success_percent)
    }
}

impl<'a> Selected<'a> {
    /// The figures of its test on a set or version; `None` if it was not tested there.
    pub fn test(&self, tested_on: &str) -> Option<&'a TestResult> {
        self.result.results.get(tested_on)
    }

    /// The success rate on `version`, %; `None` if it was not tested there.
    pub fn rate(&self, version: Version) -> Option<f64> {
        Some(self.test(&version.to_string())?.success_percent)
    }

    /// The figures of the test that selects.
    pub fn own_test(&self) -> Option<&'a TestResult> {
        self.test(&self.cell.trained_on().to_string())
    }

    /// The highest is selected.
    fn rank(&self) -> Option<(f64, f64)> {
        self.own_test().map(|test| (test.success_percent, test.mean_return))
    }
}

/// A metric averaged over the environments of `selections`, in each run that all of them have; mean and deviation over
/// these runs.
pub fn average(selections: &[&MethodResults<'_>], metric: Metric) -> Option<Summary> {
    let runs = common_runs(selections, metric);
    Summary::of(&runs.into_iter().map(|(_, numbers)| mean(numbers.into_iter())).collect::<Vec<_>>())
}

/// The interquartile mean of a metric over the environments of `selections` and the runs that all of them have, with
/// its bootstrap interval.
pub fn interquartile(selections: &[&MethodResults<'_>], metric: Metric, resamples: usize) -> Option<Bootstrapped> {
    Bootstrapped::of(&scores(selections, metric), resamples, 1, interquartile_mean)
}

/// A metric by `selections`, then by the runs that all of them have.
pub fn scores(selections: &[&MethodResults<'_>], metric: Metric) -> Vec<Vec<f64>> {
    let runs = common_runs(selections, metric);
    (0..selections.len()).map(|i| runs.iter().map(|(_, numbers)| numbers[i]).collect()).collect()
}

/// Each run that all `selections` have, with the metric in each of them.
pub(crate) fn common_runs(selections: &[&MethodResults<'_>], metric: Metric) -> Vec<(u32, Vec<f64>)> {
    let by_environment: Vec<BTreeMap<u32, f64>> = selections.iter().map(|selection| selection.metric(metric)).collect();
    let of_run = |run: &u32| {
        let numbers: Option<_> = by_environment.iter().map(|runs| runs.get(run).copied()).collect();
        Some((*run, numbers?))
    };
    by_environment.first().map_or_else(Vec::new, |first| first.keys().filter_map(of_run).collect())
}

#[cfg(test)]
#[path = "selection_tests.rs"]
mod tests;
