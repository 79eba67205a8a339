//! The worst tenth of episodes and of contexts.

use perturb_experiment::{MethodResults, Recorded};
use perturb_protocol::Version;
use perturb_records::TrainedOn;
use perturb_records::outcomes::{Outcomes, SHARE, conditional_value_at_risk, worst_contexts};
use perturb_records::statistics::{Summary, mean};
use perturb_settings::Method;
use perturb_text::{Column, Entry, Table};

use super::Report;
use super::columns::MethodColumns;
use super::index::ReportIndex;
use super::numbers::or_empty;
use super::tested::{PolicyGroup, trained};

/// Stands for a number that cannot be had.
const NONE: &str = "–";

/// Tail risk of a test, over runs.
pub(super) struct TailRisk<'a> {
    environment: &'a str,
    method: &'a Method,
    trained_on: TrainedOn<'a>,
    tested_on: &'a str,
    mean_return: Summary,
    /// Conditional value at risk.
    worst_return: Summary,
    /// %; `None` where there are too few contexts.
    worst_contexts: Option<Summary>,
}

/// In the order of `selections`, of what they were trained on, and of the plan's tests.
pub(super) fn worst<'a>(
    scope: &ReportIndex<'a>,
    selections: &'a [MethodResults<'a>],
    recorded: &'a Recorded,
) -> Vec<TailRisk<'a>> {
    let of = |trained: &PolicyGroup<'a>, tested_on: &'a str| {
        let over_runs = |number: fn(&Outcomes) -> Option<f64>| {
            Summary::from_values(&trained.tests(tested_on).filter_map(number).collect::<Vec<_>>())
        };
        Some(TailRisk {
            environment: trained.environment,
            method: trained.method,
            trained_on: trained.trained_on,
            tested_on,
            mean_return: over_runs(|test| Some(mean(test.returns.iter().copied())))?,
            worst_return: over_runs(|test| Some(conditional_value_at_risk(&test.returns, SHARE)))?,
            worst_contexts: over_runs(worst_contexts),
        })
    };
    let all = trained(selections, recorded).into_iter().flatten();
    all.flat_map(|trained| scope.tested_on.iter().filter_map(|name| of(&trained, name)).collect::<Vec<_>>()).collect()
}

impl Report<'_> {
    /// Returns a table for each environment with recorded episodes.
    pub(super) fn worst_tables(&self) -> Vec<Table> {
        let of_environments = self.worst.chunk_by(|a, b| a.environment == b.environment);
        of_environments.map(worst_table).collect()
    }

    pub(super) fn worst_file(&self) -> Table {
        Table::builder("cvar.csv", &self.worst)
            .text("environment", |row| row.environment)
            .method(|row| row.method)
            .text("train", |row| row.trained_on)
            .text("test", |row| row.tested_on)
            .number("runs", |row| row.worst_return.runs)
            .number("mean_return", |row| row.mean_return.mean)
            .number("cvar_10_mean", |row| row.worst_return.mean)
            .number("cvar_10_std", |row| or_empty(row.worst_return.std))
            .number("worst_contexts_success_mean", |row| or_empty(row.worst_contexts.map(|success| success.mean)))
            .number("worst_contexts_success_std", |row| or_empty(row.worst_contexts.and_then(|success| success.std)))
            .build()
    }
}

fn worst_table(rows: &[TailRisk<'_>]) -> Table {
    let of_policy: Vec<&[TailRisk<'_>]> =
        rows.chunk_by(|a, b| (a.method, a.trained_on) == (b.method, b.trained_on)).collect();
    let title = format!("{}: the worst tenth", rows[0].environment);
    let mut table = Table::builder(title, &of_policy)
        .text("method", |rows| rows[0].method)
        .text("trained on", |rows| rows[0].trained_on);
    let column = |name: String, group: &str| Column { name, group: Some(group.into()), is_number: true };
    let test = |rows: &&[TailRisk<'_>], version: Version, number: fn(&TailRisk<'_>) -> Option<Summary>| {
        rows.iter().find(|row| row.tested_on == version.to_string()).and_then(number)
    };
    for version in Version::ALL {
        table = table.column(column(format!("return on {version}"), "CVaR 10 % of returns"), move |rows| {
            Entry::from(test(rows, version, |row| Some(row.worst_return)).map_or(NONE.into(), |it| it.to_string()))
        });
    }
    for version in [Version::R, Version::E] {
        let group = "success in the worst tenth of contexts, %";
        table = table.column(column(format!("contexts of {version}"), group), move |rows| {
            let success = test(rows, version, |row| row.worst_contexts);
            let heat = success.map(|success| success.mean);
            Entry { heat, ..success.map_or(NONE.into(), |success| success.to_string()).into() }
        });
    }
    table.build()
}
