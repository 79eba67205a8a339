//! Selects configurations, and computes the paper's metrics from the results of cells.
//!
//! With the clean rule, the cells that were trained after the selection are reported; see [`tuned`](super::tuned).
//!
//! With the paper's rule, one configuration is selected for each environment, method, training version and run: the
//! configuration with the highest success rate on its training version. Ties go to the higher mean return in the same
//! test. If configurations still tie, the rule cannot choose among them, so reported numbers are means over all of
//! them. `selected.csv` and heatmaps need a single cell, and use the first tied one in the plan's order. The first
//! configuration is also selected if the training version was not tested. As in the paper, the result of the test by
//! which a configuration is selected is also reported. With a large grid, this makes Default and Interpolation a little
//! too high.

use std::collections::BTreeMap;

use perturb_protocol::Version;
use perturb_records::statistics::{Bootstrapped, Summary, interquartile_mean, mean};
use perturb_records::{ExternalEvaluation, ExternalPolicy, Metric, Scenario, TestResult, TrainedOn};
use perturb_settings::Method;

use crate::folder::{CellResult, CellState, FailureRecord, FolderError};
use crate::plan::{Cell, Plan, Selection};
use crate::states::CellStates;
use crate::tuning::{Tuned, tuned};

/// The states of all cells of a plan, with their results.
#[derive(Debug)]
pub struct Results<'a> {
    /// The plan.
    pub plan: &'a Plan,
    /// The state of each cell, by its index in the plan.
    pub states: Vec<CellState>,
}

/// The selected policies of one method in one environment. They correspond to a row of the paper's tables.
#[derive(Clone, Debug, PartialEq)]
pub struct MethodResults<'a> {
    /// The environment's name.
    pub environment: &'a str,
    /// The method: algorithm, architecture and kind of observation.
    pub method: Method,
    /// Number of cells of this method and environment, including cells that will be trained after the selection. Cells
    /// that are trained on parameter sets of the plan do not count.
    pub cells: usize,
    /// Number of these cells that have a result. If it is below `cells`, the selection is among fewer configurations
    /// than the plan has.
    pub done: usize,
    /// The selected policies of each run, by the run's number, from 1.
    pub runs: BTreeMap<u32, SelectedRun<'a>>,
}

/// The selected policies of one run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SelectedRun<'a> {
    /// The selected policy for each training version or set; `None` while there is no result.
    pub selected: BTreeMap<TrainedOn<'a>, Option<Reported<'a>>>,
    /// Other cells that tie with the selected one: the same success rate and mean return in the selection test. They
    /// are in the plan's order.
    pub tied: BTreeMap<TrainedOn<'a>, Vec<Selected<'a>>>,
}

/// The lowest and the highest value that a metric can have, depending on which of the tied configurations are chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TieRange {
    /// The largest number of different choices in any run. If configurations tie on several training versions, each
    /// combination is a choice.
    pub choices: usize,
    /// The metric if each run made its lowest choice, averaged over runs, %.
    pub low: f64,
    /// The metric if each run made its highest choice, averaged over runs, %.
    pub high: f64,
}

/// A policy whose tests are reported.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reported<'a> {
    /// The policy of a selected cell.
    Cell(Selected<'a>),
    /// A policy that was trained elsewhere, with its assessment.
    External(&'a ExternalEvaluation, &'a ExternalPolicy),
}

/// A selected cell with its result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Selected<'a> {
    /// The cell in the plan.
    pub cell: &'a Cell,
    /// The cell's result.
    pub result: &'a CellResult,
}

impl<'a> Results<'a> {
    /// Reads the states of all cells of `plan`. To include the cells that are trained after a selection, pass the plan
    /// that [`Plan::with_selected_cells`] returns.
    ///
    /// # Errors
    /// [`FolderError`] if a state cannot be read, or if results in one environment were trained with different models.
    pub fn read(plan: &'a Plan, states: &dyn CellStates) -> Result<Self, FolderError> {
        let states = plan.cells.iter().map(|cell| states.state(cell)).collect::<Result<_, _>>()?;
        let results = Self { plan, states };
        results.check_models()?;
        Ok(results)
    }

    /// Returns an error if results in one environment were trained with different models.
    fn check_models(&self) -> Result<(), FolderError> {
        let mut first: BTreeMap<&str, &CellResult> = BTreeMap::new();
        for result in self.done() {
            let training = &result.training;
            let known = first.entry(&training.environment).or_insert(result);
            if known.training.model_hash != training.model_hash {
                return Err(FolderError::Models {
                    environment: training.environment.clone(),
                    cells: Box::new([known.id.clone(), result.id.clone()]),
                    hashes: Box::new([known.training.model_hash.clone(), training.model_hash.clone()]),
                });
            }
        }
        Ok(())
    }

    /// Returns the results of finished cells in the plan's order.
    pub fn done(&self) -> impl Iterator<Item = &CellResult> {
        self.states.iter().filter_map(|state| match state {
            CellState::Done(result) => Some(&**result),
            _ => None,
        })
    }

    /// Returns the failures of cells in the plan's order.
    pub fn failures(&self) -> impl Iterator<Item = &FailureRecord> {
        self.states.iter().filter_map(|state| match state {
            CellState::Failed(failure) => Some(failure),
            _ => None,
        })
    }

    /// Returns the progress and the result of the selection among tuning cells, for each environment, method and
    /// training distribution. See [`tuned`](crate::tuned).
    pub fn tuned(&self) -> Vec<Tuned<'_>> {
        tuned(self.plan, &self.states)
    }

    /// Returns the selected policies of each environment and method, in the plan's order.
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
    /// Counts a tuning cell. The first tuning cell of a training distribution also adds `runs` to the number of cells,
    /// because that many cells will be trained after the selection.
    fn tune(&mut self, cell: &'a Cell, state: &'a CellState, runs: u32) {
        let counts_as_cell = usize::from(cell.set.is_none());
        self.cells += counts_as_cell;
        self.done += counts_as_cell * usize::from(matches!(state, CellState::Done(_)));
        for run in 1..=runs {
            self.runs.entry(run).or_default().selected.entry(cell.trained_on()).or_insert_with(|| {
                self.cells += counts_as_cell;
                None
            });
        }
    }

    /// Lets `cell` take part in the selection of its run. Must be called in the plan's order.
    fn consider(&mut self, cell: &'a Cell, state: &'a CellState) {
        let counts_as_cell = usize::from(cell.set.is_none());
        let run = self.runs.entry(cell.run).or_default();
        let best = run.selected.entry(cell.trained_on()).or_default();
        let CellState::Done(result) = state else { return };
        self.done += counts_as_cell;
        let candidate = Selected { cell, result };
        let best_rank = best.and_then(|best| best.cell()).map(|best| best.rank());
        if best_rank.is_none_or(|best_rank| candidate.rank() > best_rank) {
            *best = Some(Reported::Cell(candidate));
            run.tied.remove(&cell.trained_on());
        } else if candidate.rank().is_some() && best_rank == Some(candidate.rank()) {
            run.tied.entry(cell.trained_on()).or_default().push(candidate);
        }
    }

    /// Returns a metric, %, by number of the run. Tied configurations are averaged. Runs that lack a needed test are
    /// left out.
    pub fn metric(&self, metric: Metric) -> BTreeMap<u32, f64> {
        let of_run = |(&number, run): (&u32, &SelectedRun<'_>)| {
            let values = run.metric_by_choice(metric);
            (!values.is_empty()).then(|| (number, mean(values.into_iter())))
        };
        self.runs.iter().filter_map(of_run).collect()
    }

    /// Returns the range of a metric over all choices among tied configurations. Returns `None` if no run with this
    /// metric has a tie.
    pub fn tie_range(&self, metric: Metric) -> Option<TieRange> {
        let by_run = self.runs.values().map(|run| run.metric_by_choice(metric));
        let by_run: Vec<Vec<f64>> = by_run.filter(|values| !values.is_empty()).collect();
        let choices = by_run.iter().map(Vec::len).max().filter(|choices| *choices > 1)?;
        let low = mean(by_run.iter().map(|values| values.iter().copied().fold(f64::INFINITY, f64::min)));
        let high = mean(by_run.iter().map(|values| values.iter().copied().fold(f64::NEG_INFINITY, f64::max)));
        Some(TieRange { choices, low, high })
    }

    /// Returns a metric's mean and standard deviation over runs, %. Returns `None` if no run has the metric.
    pub fn summary(&self, metric: Metric) -> Option<Summary> {
        Summary::from_values(&self.metric(metric).into_values().collect::<Vec<_>>())
    }

    /// Summarizes one quantity of a test's result, for example its mean return, over runs. `figure` reads the quantity
    /// from the result. The policies were trained on `trained_on` and tested on the set or version `tested_on`. Tied
    /// configurations of a run are averaged. Returns `None` if no run has the test.
    pub fn test(&self, trained_on: TrainedOn<'_>, tested_on: &str, figure: fn(&TestResult) -> f64) -> Option<Summary> {
        let of_run = |run: &SelectedRun<'_>| run.mean_over_ties(trained_on, tested_on, figure);
        Summary::from_values(&self.runs.values().filter_map(of_run).collect::<Vec<_>>())
    }
}

impl<'a> SelectedRun<'a> {
    /// Returns the selected policy that was trained on the distribution `trained_on`; the first one if several tie.
    pub fn trained_on(&self, trained_on: TrainedOn<'_>) -> Option<Reported<'a>> {
        self.selected.get(&trained_on).copied().flatten()
    }

    /// Returns the selected policy that was trained on the distribution `trained_on`, and the policies that tie with
    /// the selected one, in the plan's order.
    pub fn tied_on(&self, trained_on: TrainedOn<'_>) -> Vec<Reported<'a>> {
        let tied = self.tied.get(&trained_on).into_iter().flatten().copied().map(Reported::Cell);
        self.trained_on(trained_on).into_iter().chain(tied).collect()
    }

    /// Returns one quantity of a test's result, averaged over tied configurations. Returns `None` if one of the
    /// configurations has no test on `tested_on`.
    fn mean_over_ties(
        &self,
        trained_on: TrainedOn<'_>,
        tested_on: &str,
        figure: fn(&TestResult) -> f64,
    ) -> Option<f64> {
        let figures: Option<Vec<f64>> =
            self.tied_on(trained_on).iter().map(|reported| reported.test(tested_on).map(figure)).collect();
        figures.filter(|figures| !figures.is_empty()).map(|figures| mean(figures.into_iter()))
    }

    /// Returns the values of a metric, %, one for each choice among tied configurations. Returns an empty list if the
    /// run lacks a needed test.
    fn metric_by_choice(&self, metric: Metric) -> Vec<f64> {
        let choices = Version::ALL.map(|train| {
            // If the metric can be computed without the scenarios of this training version, it does not depend on the
            // choice.
            let matters = metric.value(|scenario| (scenario.train != train).then_some(0.0)).is_none();
            let tied = self.tied_on(TrainedOn::Version(train)).into_iter().map(Some).take(if matters {
                usize::MAX
            } else {
                1
            });
            let tied: Vec<Option<Reported<'a>>> = tied.collect();
            if tied.is_empty() { vec![None] } else { tied }
        });
        let [on_d, on_r, on_e] = &choices;
        let mut values = Vec::new();
        for d in on_d {
            for r in on_r {
                for e in on_e {
                    let chosen = [d, r, e];
                    let rate = |Scenario { train, test }| chosen[train as usize].as_ref()?.rate(test);
                    values.extend(metric.value(rate));
                }
            }
        }
        values
    }

    /// Returns the selected cell that was trained on this distribution. Returns `None` if there is none, or if the
    /// policy was trained elsewhere.
    pub fn cell_trained_on(&self, trained_on: TrainedOn<'_>) -> Option<Selected<'a>> {
        self.trained_on(trained_on)?.cell()
    }

    /// Returns the success rate in a scenario, %, averaged over tied configurations. Returns `None` if one of the
    /// configurations has no such test.
    pub fn rate(&self, Scenario { train, test }: Scenario) -> Option<f64> {
        self.mean_over_ties(TrainedOn::Version(train), &test.to_string(), |test| test.success_percent)
    }
}

impl<'a> Reported<'a> {
    /// Returns the cell; `None` for a policy that was trained elsewhere.
    pub fn cell(&self) -> Option<Selected<'a>> {
        match self {
            Self::Cell(selected) => Some(*selected),
            Self::External(..) => None,
        }
    }

    /// Returns the test of the policy on a set or version; `None` if there is none.
    pub fn test(&self, tested_on: &str) -> Option<&'a TestResult> {
        match self {
            Self::Cell(selected) => selected.test(tested_on),
            Self::External(_, policy) => policy.test(tested_on),
        }
    }

    /// Returns the success rate on `version`, %; `None` if there is no such test.
    pub fn rate(&self, version: Version) -> Option<f64> {
        Some(self.test(&version.to_string())?.success_percent)
    }
}

impl<'a> Selected<'a> {
    /// Returns the test of the policy on a set or version; `None` if there is none.
    pub fn test(&self, tested_on: &str) -> Option<&'a TestResult> {
        self.result.results.get(tested_on)
    }

    /// Returns the success rate on `version`, %; `None` if there is no such test.
    pub fn rate(&self, version: Version) -> Option<f64> {
        Some(self.test(&version.to_string())?.success_percent)
    }

    /// Returns the test on the training distribution. The paper's rule selects cells by this test.
    fn own_test(&self) -> Option<&'a TestResult> {
        self.test(&self.cell.trained_on().to_string())
    }

    /// Returns the cell's rank for the paper's rule, which selects the cell with the highest rank: the success rate (%)
    /// and the mean return in the test on the training distribution. Returns `None` if the cell has no such test.
    fn rank(&self) -> Option<(f64, f64)> {
        self.own_test().map(|test| (test.success_percent, test.mean_return))
    }
}

/// Averages a metric over the environments of `selections`, and returns mean and standard deviation over runs, %. Uses
/// only runs that all `selections` have; returns `None` if there are none.
pub fn average(selections: &[&MethodResults<'_>], metric: Metric) -> Option<Summary> {
    let runs = common_runs(selections, metric);
    Summary::from_values(&runs.into_iter().map(|(_, numbers)| mean(numbers.into_iter())).collect::<Vec<_>>())
}

/// Averages [`MethodResults::tie_range`] over the environments of `selections`. An environment without ties counts with
/// its mean. Unlike [`average`], uses all runs of each environment. Returns `None` if there are no ties, or if an
/// environment lacks the metric.
pub fn average_tie_range(selections: &[&MethodResults<'_>], metric: Metric) -> Option<TieRange> {
    let ranges: Vec<Option<TieRange>> = selections.iter().map(|selection| selection.tie_range(metric)).collect();
    let choices = ranges.iter().flatten().map(|range| range.choices).max()?;
    let mut ends = [0.0; 2];
    for (selection, range) in selections.iter().zip(ranges) {
        let without_ties = selection.summary(metric)?.mean;
        let of_environment = range.map_or([without_ties; 2], |range| [range.low, range.high]);
        ends.iter_mut().zip(of_environment).for_each(|(end, value)| *end += value / selections.len() as f64);
    }
    Some(TieRange { choices, low: ends[0], high: ends[1] })
}

/// Returns the interquartile mean of a metric, %, with its bootstrap interval. The mean is over all environments of
/// `selections`, and over the runs that all of them have.
pub fn interquartile(selections: &[&MethodResults<'_>], metric: Metric, resamples: usize) -> Option<Bootstrapped> {
    Bootstrapped::new(&scores(selections, metric), resamples, 1, interquartile_mean)
}

/// Returns a list of a metric's values, %, for each of `selections`. A list has one value for each run that all of
/// `selections` have.
pub fn scores(selections: &[&MethodResults<'_>], metric: Metric) -> Vec<Vec<f64>> {
    let runs = common_runs(selections, metric);
    (0..selections.len()).map(|i| runs.iter().map(|(_, numbers)| numbers[i]).collect()).collect()
}

/// Returns the runs that all `selections` have. A run is returned as its number and a list of the metric's values, %,
/// one for each of `selections`.
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
