//! Methods on an equal footing: how long their trainings were, and how well they did after as many steps, and as many
//! episodes, as all of them have.

use perturb_checkpoint::Counters;
use perturb_experiment::{BudgetAxis, Curve, CurvePoint, EnvironmentCurves, MethodResults};
use perturb_protocol::Version;
use perturb_records::TrainedOn;
use perturb_records::statistics::Summary;
use perturb_settings::Method;
use perturb_text::Table;

use super::columns::MethodColumns;
use super::numbers::or_empty;
use super::{MISSING, Report};

/// The selected trainings of a method on a version.
pub(super) struct SampleEfficiency<'a> {
    environment: &'a str,
    method: &'a Method,
    version: Version,
    counters: Vec<Counters>,
    /// By episodes and by steps: the least that a method's trainings of the same version have, and the part of these
    /// trainings that has it in its middle or next after it. `None` without their logs.
    equal: [Option<(f64, CurvePoint)>; 2],
}

/// Returns the trainings with results in the order of `selections`.
pub(super) fn trainings<'a>(
    selections: &'a [MethodResults<'a>],
    curves: &[EnvironmentCurves],
) -> Vec<SampleEfficiency<'a>> {
    let of = |selection: &'a MethodResults<'a>, version: Version| {
        let selected = selection.runs.values().filter_map(|run| run.cell_trained_on(TrainedOn::Version(version)));
        let counters: Vec<Counters> = selected.map(|selected| selected.result.training.counters).collect();
        let of_environment = curves.iter().find(|of| of.environment == selection.environment);
        let same = || of_environment.into_iter().flat_map(|of| &of.curves).filter(|curve| curve.version == version);
        let own = same().find(|curve| curve.method == selection.method);
        let equal = |by: BudgetAxis| {
            let least = same().map(|curve: &Curve| curve.total(by)).fold(f64::INFINITY, f64::min);
            own.and_then(|curve| Some((least, *curve.at(by, least)?)))
        };
        let (environment, method, equal) = (selection.environment, &selection.method, BudgetAxis::ALL.map(equal));
        (!counters.is_empty()).then_some(SampleEfficiency { environment, method, version, counters, equal })
    };
    selections
        .iter()
        .flat_map(|selection| Version::KNOWN.into_iter().filter_map(move |version| of(selection, version)))
        .collect()
}

impl SampleEfficiency<'_> {
    /// Mean over runs.
    fn mean(&self, count: fn(&Counters) -> u64) -> f64 {
        let counts: Vec<f64> = self.counters.iter().map(|counters| count(counters) as f64).collect();
        Summary::from_values(&counts).map_or(f64::NAN, |summary| summary.mean)
    }

    fn equal(&self, by: BudgetAxis) -> Option<(f64, CurvePoint)> {
        self.equal[by as usize]
    }
}

/// Episodes that ended; results of programs that did not count them have those of the budget.
fn generated(counters: &Counters) -> u64 {
    counters.generated_episodes.max(counters.episodes)
}

impl Report<'_> {
    /// Returns a table for each environment.
    pub(super) fn footing_tables(&self) -> Vec<Table> {
        self.trainings.chunk_by(|a, b| a.environment == b.environment).map(footing_table).collect()
    }

    pub(super) fn footing_file(&self) -> Table {
        let mut table = Table::builder("sample_efficiency.csv", &self.trainings)
            .text("environment", |row| row.environment)
            .method(|row| row.method)
            .text("train", |row| row.version)
            .number("runs", |row| row.counters.len())
            .number("steps", |row| row.mean(|counters| counters.timesteps))
            .number("learned_steps", |row| row.mean(|counters| counters.learned_timesteps))
            .number("generated_episodes", |row| row.mean(generated))
            .number("episodes", |row| row.mean(|counters| counters.episodes))
            .number("iterations", |row| row.mean(|counters| counters.iterations));
        for by in BudgetAxis::ALL {
            table = table
                .number(format!("equal_{by}"), move |row| or_empty(row.equal(by).map(|(least, _)| least)))
                .number(format!("success_at_equal_{by}_mean"), move |row| {
                    or_empty(row.equal(by).map(|(_, point)| point.success.mean))
                })
                .number(format!("success_at_equal_{by}_std"), move |row| {
                    or_empty(row.equal(by).and_then(|(_, point)| point.success.std))
                });
        }
        table.build()
    }
}

fn footing_table(rows: &[SampleEfficiency<'_>]) -> Table {
    let title = format!("{}: trainings on an equal footing", rows[0].environment);
    let mut table = Table::builder(title, rows)
        .text("method", |row| row.method)
        .text("trained on", |row| row.version)
        .number("steps", |row| whole(row.mean(|counters| counters.timesteps)))
        .number("episodes", |row| whole(row.mean(generated)))
        .number("iterations", |row| whole(row.mean(|counters| counters.iterations)));
    for by in BudgetAxis::ALL {
        let missing = || MISSING.to_owned();
        table = table
            .number(format!("{by} that all have"), move |row| {
                row.equal(by).map_or_else(missing, |(least, _)| whole(least))
            })
            .number("success, %", move |row| {
                row.equal(by).map_or_else(missing, |(_, point)| point.success.to_string())
            });
    }
    table.build()
}

fn whole(number: f64) -> String {
    format!("{number:.0}")
}
