//! Generalisation against training: tests of the selected trainings' policies at earlier moments, and at the end.

use std::collections::BTreeSet;

use perturb_experiment::{BudgetAxis, Curve, CurvePoint, EnvironmentCurves, MethodResults, Selected, distinct};
use perturb_protocol::Version;
use perturb_records::statistics::Summary;
use perturb_records::{TestResult, TrainedOn};
use perturb_settings::Method;

/// A policy's test at one moment of its training.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct GeneralizationPoint<'a> {
    pub(crate) environment: &'a str,
    pub(crate) method: &'a Method,
    pub(crate) trained_on: TrainedOn<'a>,
    /// Episodes of the training's budget.
    pub(crate) episodes: u64,
    pub(crate) tested_on: &'a str,
    /// %, over runs.
    pub(crate) success: Option<Summary>,
    /// Over runs.
    pub(crate) mean_return: Option<Summary>,
}

/// In the order of `selections`, of what they were trained on, of moments, and of the tests; nothing of
/// trainings without marks.
pub(crate) fn generalization_curves<'a>(selections: &'a [MethodResults<'a>]) -> Vec<GeneralizationPoint<'a>> {
    let mut tests = Vec::new();
    for selection in selections {
        let trained_on: BTreeSet<TrainedOn<'a>> =
            selection.runs.values().flat_map(|run| run.selected.keys().copied()).collect();
        for trained_on in trained_on {
            let selected: Vec<Selected<'a>> =
                selection.runs.values().filter_map(|run| run.cell_trained_on(trained_on)).collect();
            let marked = selected.iter().filter(|of| !of.result.marks.is_empty());
            let moments: BTreeSet<u64> = marked.clone().flat_map(moments_of).collect();
            let tested = marked.flat_map(|of| &of.cell.tests.sets).map(|set| set.name.as_str());
            let names = distinct(tested);
            for episodes in moments {
                tests.extend(names.iter().map(|tested_on| {
                    let over_runs = |figure: fn(&TestResult) -> f64| {
                        let figures = selected.iter().filter_map(|of| test(of, episodes, tested_on).map(figure));
                        Summary::from_values(&figures.collect::<Vec<_>>())
                    };
                    GeneralizationPoint {
                        environment: selection.environment,
                        method: &selection.method,
                        trained_on,
                        episodes,
                        tested_on,
                        success: over_runs(|test| test.success_percent),
                        mean_return: over_runs(|test| test.mean_return),
                    }
                }));
            }
        }
    }
    tests
}

/// Returns the curves of `tests` over the training's budget, for each environment and training version. The version of
/// a curve is that of the test.
pub(crate) fn test_curves(tests: &[GeneralizationPoint<'_>]) -> Vec<(Version, EnvironmentCurves)> {
    let known = |name: &str| Version::KNOWN.into_iter().find(|version| version.to_string() == name);
    let mut all = Vec::new();
    for environment in distinct(tests.iter().map(|test| test.environment)) {
        for trained_on in Version::KNOWN {
            let of = |test: &&GeneralizationPoint<'_>| {
                test.environment == environment && test.trained_on == TrainedOn::Version(trained_on)
            };
            let mut curves: Vec<Curve> = Vec::new();
            for test in tests.iter().filter(of) {
                let (Some(version), Some(success), Some(episode_return)) =
                    (known(test.tested_on), test.success, test.mean_return)
                else {
                    continue;
                };
                let point = CurvePoint { progress: test.episodes as f64, episode_return, success };
                let same = |curve: &&mut Curve| curve.method == *test.method && curve.version == version;
                match curves.iter_mut().find(same) {
                    Some(curve) => curve.add(BudgetAxis::Episodes, point),
                    None => {
                        let mut curve = Curve::new(test.method, version);
                        curve.add(BudgetAxis::Episodes, point);
                        curves.push(curve);
                    }
                }
            }
            if !curves.is_empty() {
                all.push((trained_on, EnvironmentCurves { environment: environment.to_owned(), curves }));
            }
        }
    }
    all
}

/// The marks and the end.
fn moments_of<'a>(selected: &Selected<'a>) -> impl Iterator<Item = u64> + use<'a> {
    selected.result.marks.keys().copied().chain([selected.cell.config.common.episodes])
}

fn test<'a>(selected: &Selected<'a>, episodes: u64, tested_on: &str) -> Option<&'a TestResult> {
    let at_the_end = episodes == selected.cell.config.common.episodes;
    let at_mark = || selected.result.marks.get(&episodes).map(|mark| &mark.results);
    if at_the_end { Some(&selected.result.results) } else { at_mark() }?.get(tested_on)
}
