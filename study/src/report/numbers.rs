//! The numbers of a report, beside the paper's.

use std::collections::BTreeMap;

use crate::outcomes::Counted;
use crate::paper;
use crate::plan::{Plan, TrainedOn};
use crate::reselection::Reselection;
use crate::selection::{MethodResults, average, interquartile, scores};
use crate::statistics::{Bootstrapped, Summary, interquartile_mean, optimality_gap};
use crate::{Method, Metric, Scenario, TestResult, Version};

/// Resamples of a bootstrap, as many as rliable takes.
const RESAMPLES: usize = 50_000;
/// Of one that selects anew, hundreds of times in each of them.
const RESELECTIONS: usize = 10_000;
/// The best success rate, %, from which the optimality gap is.
const BEST: f64 = 100.0;
/// What stands for all environments together, here and in the paper.
const AVERAGE: &str = "Average";

/// A method's metrics in an environment, or over all; a metric that is not known is not there.
pub(super) struct MethodMetrics<'a> {
    pub(super) environment: &'a str,
    pub(super) method: Method,
    pub(super) ours: BTreeMap<Metric, Summary>,
    pub(super) papers: BTreeMap<Metric, Summary>,
    /// Of all environments only.
    pub(super) iqms: BTreeMap<Metric, Bootstrapped>,
    /// Likewise.
    pub(super) gaps: BTreeMap<Metric, Bootstrapped>,
    /// Both once more, with every selection made anew in each resample.
    pub(super) reselected: BTreeMap<Metric, [Bootstrapped; 2]>,
    pub(super) done: usize,
    pub(super) cells: usize,
}

/// A test that the paper has no place for: of a policy that was trained on one of the plan's own sets, or on one.
pub(super) struct SetTest<'a> {
    pub(super) environment: &'a str,
    pub(super) method: &'a Method,
    pub(super) trained_on: TrainedOn<'a>,
    pub(super) tested_on: &'a str,
    pub(super) success: Option<Summary>,
    pub(super) mean_return: Option<Summary>,
}

impl MethodMetrics<'_> {
    /// Ours less the paper's.
    pub(super) fn difference(&self, metric: Metric) -> Option<f64> {
        Some(self.ours.get(&metric)?.mean - self.papers.get(&metric)?.mean)
    }

    /// How many runs all metrics have.
    pub(super) fn runs(&self) -> usize {
        least(|metric| self.ours.get(&metric).map(|summary| summary.runs))
    }

    /// How many runs all interquartile means have.
    pub(super) fn iqm_runs(&self) -> usize {
        least(|metric| self.iqms.get(&metric).map(|iqm| iqm.runs))
    }
}

/// Of each selection.
pub(super) fn metrics<'a>(selections: &[MethodResults<'a>]) -> Vec<MethodMetrics<'a>> {
    let of_selection = |selection: &MethodResults<'a>| MethodMetrics {
        environment: selection.environment,
        method: selection.method.clone(),
        ours: known(|metric| selection.summary(metric)),
        papers: known(|metric| paper::number(selection.environment, &selection.method, metric)),
        iqms: BTreeMap::new(),
        gaps: BTreeMap::new(),
        reselected: BTreeMap::new(),
        done: selection.done,
        cells: selection.cells,
    };
    selections.iter().map(of_selection).collect()
}

/// Averaged over the plan's environments.
pub(super) fn averages<'a>(
    plan: &Plan,
    selections: &[MethodResults<'a>],
    reselection: &Reselection<'a>,
) -> Vec<MethodMetrics<'static>> {
    let environments = plan.environments();
    let of_method = |method: Method| {
        let found: Vec<_> = selections.iter().filter(|selection| selection.method == method).collect();
        let everywhere = found.len() == environments.len();
        let gap = |strata: &[Vec<f64>]| optimality_gap(strata, BEST);
        let both = |strata: &[Vec<f64>]| vec![interquartile_mean(strata), gap(strata)];
        let reselected = |metric| reselection.bootstrap(&found, metric, RESELECTIONS, both)?.try_into().ok();
        let gap = |metric| Bootstrapped::of(&scores(&found, metric), RESAMPLES, 1, gap);
        MethodMetrics {
            environment: AVERAGE,
            ours: known(|metric| average(&found, metric).filter(|_| everywhere)),
            papers: known(|metric| paper::average(&environments, &method, metric)),
            iqms: known(|metric| interquartile(&found, metric, RESAMPLES).filter(|_| everywhere)),
            gaps: known(|metric| gap(metric).filter(|_| everywhere)),
            reselected: known(|metric| reselected(metric).filter(|_| everywhere)),
            done: found.iter().map(|selection| selection.done).sum(),
            cells: found.iter().map(|selection| selection.cells).sum(),
            method,
        }
    };
    plan.methods().into_iter().map(of_method).collect()
}

/// In the order of `selections`, of what they were trained on, and of the plan's tests.
pub(super) fn set_tests<'a>(plan: &'a Plan, selections: &'a [MethodResults<'a>]) -> Vec<SetTest<'a>> {
    let is_version = |name: &str| Version::KNOWN.iter().any(|version| version.to_string() == name);
    let mut tests = Vec::new();
    for selection in selections {
        for &trained_on in selection.runs.values().next().into_iter().flat_map(|run| run.0.keys()) {
            let is_of_set = matches!(trained_on, TrainedOn::Set(_));
            tests.extend(tested_on(plan).filter(|name| is_of_set || !is_version(name)).map(|tested_on| SetTest {
                environment: selection.environment,
                method: &selection.method,
                trained_on,
                tested_on,
                success: selection.test(trained_on, tested_on, |test| test.success_percent),
                mean_return: selection.test(trained_on, tested_on, |test| test.mean_return),
            }));
        }
    }
    tests
}

/// The test episodes of a scenario, of all runs together.
pub(super) fn counted(selection: &MethodResults<'_>, Scenario { train, test }: Scenario) -> Counted {
    let trained = selection.runs.values().filter_map(|run| run.trained_on(TrainedOn::Version(train)));
    let tests = trained.filter_map(|selected| selected.test(&test.to_string()));
    let of = |test: &TestResult| Counted {
        successes: (test.success_percent * test.episodes as f64 / 100.0).round() as u64,
        episodes: test.episodes,
    };
    tests.map(of).sum()
}

/// A field of a file.
pub(super) fn or_empty(number: Option<impl ToString>) -> String {
    number.map(|number| number.to_string()).unwrap_or_default()
}

/// The names of what the plan tests on.
pub(super) fn tested_on(plan: &Plan) -> impl Iterator<Item = &str> {
    plan.cells.iter().take(1).flat_map(|cell| &cell.tests.sets).map(|set| set.name.as_str())
}

fn known<T>(of: impl Fn(Metric) -> Option<T>) -> BTreeMap<Metric, T> {
    Metric::ALL.into_iter().filter_map(|metric| Some((metric, of(metric)?))).collect()
}

fn least(runs: impl Fn(Metric) -> Option<usize>) -> usize {
    Metric::ALL.into_iter().map(|metric| runs(metric).unwrap_or(0)).min().unwrap_or(0)
}
