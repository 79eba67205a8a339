//! Computes the metrics of a report, and pairs them with the paper's numbers.

use std::collections::{BTreeMap, BTreeSet};

use perturb_experiment::{
    MethodResults, SelectedRun, SelectionBootstrap, TieRange, average, average_tie_range, interquartile, scores,
};
use perturb_records::outcomes::SuccessCount;
use perturb_records::statistics::{Bootstrapped, Summary, interquartile_mean, mean_with_t_interval, optimality_gap};
use perturb_records::{Metric, Scenario, TestResult, TrainedOn, paper};
use perturb_settings::Method;

use super::index::{ReportIndex, has_scenarios};

/// Number of bootstrap resamples. It is the default of the Python package rliable.
const RESAMPLES: usize = 50_000;
/// Number of resamples of the bootstrap that repeats the selection of configurations. One such resample takes hundreds
/// of times longer than an ordinary one.
const N_BOOTSTRAP_SELECTION: usize = 10_000;
/// The best possible success rate, %. The optimality gap is measured from it.
const MAX_SUCCESS: f64 = 100.0;
/// The name, in reports and in the paper, of the average over environments.
pub(super) const AVERAGE: &str = "Average";

/// A method's metrics in one environment, or averaged over environments. The maps have no entry for a metric that
/// cannot be computed.
pub(super) struct MethodMetrics<'a> {
    pub(super) environment: &'a str,
    pub(super) method: Method,
    pub(super) ours: BTreeMap<Metric, Summary>,
    /// The range that `ours` can have, depending on which of the tied configurations are chosen.
    pub(super) ties: BTreeMap<Metric, TieRange>,
    pub(super) papers: BTreeMap<Metric, Summary>,
    /// Whether `ours` can be compared with `papers`: whether the environment has the paper's physics.
    pub(super) comparable: bool,
    /// The means of `ours`, with their 95 % t intervals if there are enough runs.
    pub(super) means: BTreeMap<Metric, Bootstrapped>,
    /// Scenarios with a success rate of 0 that make Extrapolation 0 in some run, although another of its three
    /// scenarios has successes.
    pub(super) zeros: BTreeSet<Scenario>,
    /// Interquartile means. Empty unless this is an average over environments.
    pub(super) iqms: BTreeMap<Metric, Bootstrapped>,
    /// Optimality gaps. Empty unless this is an average over environments.
    pub(super) gaps: BTreeMap<Metric, Bootstrapped>,
    /// Interquartile means and optimality gaps, with intervals from a bootstrap that repeats every selection in each
    /// resample.
    pub(super) reselected: BTreeMap<Metric, [Bootstrapped; 2]>,
    pub(super) done: usize,
    pub(super) cells: usize,
}

impl MethodMetrics<'_> {
    /// Returns our mean minus the paper's mean, in percentage points. Returns `None` if they cannot be compared, or one
    /// of them is missing.
    pub(super) fn difference(&self, metric: Metric) -> Option<f64> {
        self.comparable.then_some(())?;
        Some(self.ours.get(&metric)?.mean - self.papers.get(&metric)?.mean)
    }

    /// Returns the smallest number of runs of a metric; 0 if a metric is missing.
    pub(super) fn runs(&self) -> usize {
        min_runs(|metric| self.ours.get(&metric).map(|summary| summary.runs))
    }

    /// Returns the smallest number of runs in an interquartile mean; 0 if a mean is missing.
    pub(super) fn iqm_runs(&self) -> usize {
        min_runs(|metric| self.iqms.get(&metric).map(|iqm| iqm.runs))
    }
}

/// Returns the metrics of each method in each environment.
pub(super) fn metrics<'a>(selections: &[MethodResults<'a>]) -> Vec<MethodMetrics<'a>> {
    let of_selection = |selection: &MethodResults<'a>| MethodMetrics {
        environment: selection.environment,
        method: selection.method.clone(),
        ours: known(|metric| selection.summary(metric)),
        ties: known(|metric| selection.tie_range(metric)),
        papers: known(|metric| paper::number(selection.environment, &selection.method, metric)),
        comparable: paper::is_comparable(selection.environment),
        means: known(|metric| mean_with_interval(&[selection], metric)),
        zeros: zeros(&[selection]),
        iqms: BTreeMap::new(),
        gaps: BTreeMap::new(),
        reselected: BTreeMap::new(),
        done: selection.done,
        cells: selection.cells,
    };
    selections.iter().filter(|row| has_scenarios(row)).map(of_selection).collect()
}

/// Returns the metrics of each method, averaged over the environments in `scope.averaged`. Metrics of a method that
/// lacks one of these environments are left out.
pub(super) fn averages<'a>(
    scope: &ReportIndex<'_>,
    selections: &[MethodResults<'a>],
    reselection: &SelectionBootstrap<'a>,
) -> Vec<MethodMetrics<'static>> {
    let environments = &scope.averaged;
    let is_everywhere = |method: &Method| {
        let is_there = |name: &&str| selections.iter().any(|row| row.environment == *name && row.method == *method);
        environments.iter().all(is_there)
    };
    let of_method = |method: Method| {
        let is_averaged = |row: &&MethodResults<'_>| environments.contains(&row.environment);
        let found: Vec<_> = selections.iter().filter(|row| row.method == method).filter(is_averaged).collect();
        let everywhere = is_everywhere(&method);
        let gap = |strata: &[Vec<f64>]| optimality_gap(strata, MAX_SUCCESS);
        let both = |strata: &[Vec<f64>]| vec![interquartile_mean(strata), gap(strata)];
        let reselected = |metric| reselection.bootstrap(&found, metric, N_BOOTSTRAP_SELECTION, both)?.try_into().ok();
        let gap = |metric| Bootstrapped::new(&scores(&found, metric), RESAMPLES, 1, gap);
        MethodMetrics {
            environment: AVERAGE,
            ours: known(|metric| average(&found, metric).filter(|_| everywhere)),
            ties: known(|metric| average_tie_range(&found, metric).filter(|_| everywhere)),
            papers: known(|metric| paper::average(environments, &method, metric)),
            comparable: environments.iter().all(|environment| paper::is_comparable(environment)),
            means: known(|metric| mean_with_interval(&found, metric).filter(|_| everywhere)),
            zeros: zeros(&found),
            iqms: known(|metric| interquartile(&found, metric, RESAMPLES).filter(|_| everywhere)),
            gaps: known(|metric| gap(metric).filter(|_| everywhere)),
            reselected: known(|metric| reselected(metric).filter(|_| everywhere && !method.external)),
            done: found.iter().map(|selection| selection.done).sum(),
            cells: found.iter().map(|selection| selection.cells).sum(),
            method,
        }
    };
    // Agents that were trained outside of the experiment and lack some environment have no average.
    let methods = scope.methods.iter().filter(|method| !method.external || is_everywhere(method));
    methods.cloned().map(of_method).collect()
}

/// Counts the successes and the episodes of a test, over all runs and over all tied configurations. Configurations are
/// tied if they have the same result in the selection.
pub(super) fn counted(selection: &MethodResults<'_>, trained_on: TrainedOn<'_>, tested_on: &str) -> SuccessCount {
    let trained = selection.runs.values().flat_map(|run| run.tied_on(trained_on));
    let tests = trained.filter_map(|selected| selected.test(tested_on));
    let of = |test: &TestResult| SuccessCount {
        successes: (test.success_percent * test.episodes as f64 / 100.0).round() as u64,
        episodes: test.episodes,
    };
    tests.map(of).sum()
}

/// Returns a number as a CSV field, which is empty for `None`.
pub(super) fn or_empty(number: Option<impl ToString>) -> String {
    number.map(|number| number.to_string()).unwrap_or_default()
}

/// Collects a value for each metric that has one.
fn known<T>(of: impl Fn(Metric) -> Option<T>) -> BTreeMap<Metric, T> {
    Metric::ALL.into_iter().filter_map(|metric| Some((metric, of(metric)?))).collect()
}

/// Returns the mean of a metric over environments, and over the runs that all these environments have, %. Clamps its t
/// interval to 0 … 100 %.
fn mean_with_interval(selections: &[&MethodResults<'_>], metric: Metric) -> Option<Bootstrapped> {
    let mean = mean_with_t_interval(&scores(selections, metric))?;
    let interval_95 = mean.interval_95.map(|interval| interval.map(|end| end.clamp(0.0, MAX_SUCCESS)));
    Some(Bootstrapped { interval_95, ..mean })
}

/// Returns the scenarios of Extrapolation that have no success in some run, although another of its three scenarios has
/// successes in this run.
fn zeros(selections: &[&MethodResults<'_>]) -> BTreeSet<Scenario> {
    let of_run = |run: &SelectedRun<'_>| {
        let zero = |scenario: &Scenario| Some((*scenario, run.rate(*scenario)? == 0.0));
        let three: Option<Vec<(Scenario, bool)>> = Metric::EXTRAPOLATION.iter().map(zero).collect();
        let three = three.filter(|three| !three.iter().all(|(_, is_zero)| *is_zero)).unwrap_or_default();
        three.into_iter().filter_map(|(scenario, is_zero)| is_zero.then_some(scenario))
    };
    selections.iter().flat_map(|selection| selection.runs.values()).flat_map(of_run).collect()
}

/// Returns the minimum over all metrics; a missing metric counts as 0.
fn min_runs(runs: impl Fn(Metric) -> Option<usize>) -> usize {
    Metric::ALL.into_iter().map(|metric| runs(metric).unwrap_or(0)).min().unwrap_or(0)
}
