//! Success over parameters and over the threshold, of all runs together.

use perturb_experiment::{MethodResults, Recorded};
use perturb_records::outcomes::{Bin, Counted, bins, success_at, success_within, thresholds};
use perturb_records::success::{Criterion, Side};
use perturb_records::{RecordedParameter, TrainedOn};
use perturb_settings::Method;
use perturb_text::{Table, TableBuilder};

use super::Report;
use super::columns::MethodColumns;
use super::index::ReportIndex;
use super::tested::{PolicyGroup, trained};
use crate::plot::panels::PanelPoint;

/// Successes of all runs together at one place of a sweep.
pub(super) struct SweepPoint<'a, P> {
    pub(super) environment: &'a str,
    pub(super) method: &'a Method,
    pub(super) trained_on: TrainedOn<'a>,
    pub(super) tested_on: &'a str,
    pub(super) at: P,
    runs: usize,
    pub(super) counted: Counted,
}

/// A part of a parameter's range.
#[derive(Clone, Copy)]
pub(super) struct AtParameter<'a> {
    pub(super) parameter: &'a RecordedParameter,
    pub(super) bin: Bin,
}

/// A threshold in place of the criterion's own.
#[derive(Clone, Copy)]
pub(super) struct AtThreshold<'a> {
    pub(super) criterion: &'a Criterion,
    pub(super) threshold: f64,
}

impl<'a> PolicyGroup<'a> {
    fn swept<P>(&self, tested_on: &'a str, at: P, counted: impl Iterator<Item = Counted>) -> Option<SweepPoint<'a, P>> {
        let counted: Vec<Counted> = counted.collect();
        let (runs, counted): (_, Counted) = (counted.len(), counted.into_iter().sum());
        let &Self { environment, method, trained_on, .. } = self;
        (counted.episodes > 0).then_some(SweepPoint { environment, method, trained_on, tested_on, at, runs, counted })
    }
}

/// Success over each parameter that varies in a test.
pub(super) fn over_parameters<'a>(
    scope: &ReportIndex<'a>,
    selections: &'a [MethodResults<'a>],
    recorded: &'a Recorded,
) -> Vec<SweepPoint<'a, AtParameter<'a>>> {
    let mut all = Vec::new();
    for of_environment in trained(selections, recorded) {
        let Some(parameters) = of_environment.first().map(|trained| &trained.policies[0].parameters) else { continue };
        for &tested_on in &scope.tested_on {
            for (place, parameter) in parameters.iter().enumerate() {
                let bins = bins(of_environment.iter().flat_map(|trained| trained.tests(tested_on)), place);
                for trained in &of_environment {
                    let by_run: Vec<Vec<Counted>> =
                        trained.tests(tested_on).map(|test| success_within(test, place, &bins)).collect();
                    all.extend(bins.iter().enumerate().filter_map(|(index, &bin)| {
                        let at = AtParameter { parameter, bin };
                        trained.swept(tested_on, at, by_run.iter().map(|bins| bins[index]))
                    }));
                }
            }
        }
    }
    all
}

/// Success over the threshold, in environments whose success compares something with one.
pub(super) fn over_thresholds<'a>(
    scope: &ReportIndex<'a>,
    selections: &'a [MethodResults<'a>],
    recorded: &'a Recorded,
) -> Vec<SweepPoint<'a, AtThreshold<'a>>> {
    let mut all = Vec::new();
    for of_environment in trained(selections, recorded) {
        let first = of_environment.first().and_then(|trained| trained.policies[0].success.as_ref());
        let Some(criterion) = first else { continue };
        let tests = of_environment.iter().flat_map(|trained| {
            let trained = trained.clone();
            scope.tested_on.iter().flat_map(move |tested_on| trained.tests(tested_on))
        });
        let thresholds = thresholds(tests, criterion);
        for trained in &of_environment {
            for &tested_on in &scope.tested_on {
                all.extend(thresholds.iter().filter_map(|&threshold| {
                    let counted = trained.tests(tested_on).map(|test| success_at(test, criterion, threshold));
                    trained.swept(tested_on, AtThreshold { criterion, threshold }, counted)
                }));
            }
        }
    }
    all
}

impl Report<'_> {
    pub(super) fn parameters_file(&self) -> Table {
        let table = swept("parameters.csv", &self.over_parameters)
            .text("parameter", |row| &row.at.parameter.name)
            .text("unit", |row| &row.at.parameter.unit)
            .number("low", |row| row.at.bin.low)
            .number("high", |row| row.at.bin.high);
        counted(table)
    }

    pub(super) fn thresholds_file(&self) -> Table {
        let table = swept("thresholds.csv", &self.over_thresholds)
            .text("quantity", |row| &row.at.criterion.quantity)
            .text("unit", |row| &row.at.criterion.unit)
            .text("side", |row| side(row.at.criterion))
            .number("threshold", |row| row.at.threshold);
        counted(table)
    }
}

impl<P> SweepPoint<'_, P> {
    /// With its Wilson interval.
    pub(super) fn point(&self, x: f64) -> PanelPoint {
        let [low, high] = self.counted.interval();
        PanelPoint { x, y: self.counted.rate(), low, high }
    }
}

fn swept<'r, 'a, P>(name: &str, rows: &'r [SweepPoint<'a, P>]) -> TableBuilder<'r, SweepPoint<'a, P>> {
    Table::builder(name, rows)
        .text("environment", |row| row.environment)
        .method(|row| row.method)
        .text("train", |row| row.trained_on)
        .text("test", |row| row.tested_on)
}

fn counted<'r, 'a, P>(table: TableBuilder<'r, SweepPoint<'a, P>>) -> Table {
    table
        .number("runs", |row| row.runs)
        .number("episodes", |row| row.counted.episodes)
        .number("successes", |row| row.counted.successes)
        .number("success_percent", |row| row.counted.rate())
        .number("low_95", |row| row.counted.interval()[0])
        .number("high_95", |row| row.counted.interval()[1])
        .build()
}

/// In words.
pub(super) fn side(criterion: &Criterion) -> &'static str {
    match criterion.side {
        Side::AtLeast => "at least",
        Side::AtMost => "at most",
    }
}
