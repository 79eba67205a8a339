//! The numbers of a report as tables for readers.

use perturb_experiment::MethodResults;
use perturb_records::statistics::Summary;
use perturb_records::{Metric, TrainedOn};
use perturb_settings::Method;
use perturb_text::{Column, Entry, Table};

use super::index::{trained_on, version};
use super::numbers::{MethodMetrics, counted};
use super::{MISSING, Report};

/// The text for a number that does not exist, for example one that the paper does not report.
const NOT_GIVEN: &str = "–";

/// A row of a scenario table: the results of a method in an environment, and one of its training distributions.
pub(super) type ScenarioRow<'r, 'a> = (&'r MethodResults<'a>, TrainedOn<'a>);

impl Report<'_> {
    /// Returns the tables of Default, Interpolation and Extrapolation: a table of the average if there are several
    /// environments, then a table for each environment.
    pub(super) fn metrics_tables(&self) -> Vec<Table> {
        let environments = &self.scope.averaged;
        let averages = (environments.len() > 1)
            .then(|| self.metrics_table(format!("Average over {}", environments.join(", ")), &self.averages));
        let of_environments = self.metrics.chunk_by(|a, b| a.environment == b.environment);
        averages
            .into_iter()
            .chain(of_environments.map(|rows| self.metrics_table(rows[0].environment.into(), rows)))
            .collect()
    }

    /// Returns a table of metrics with a row for each method.
    fn metrics_table(&self, title: String, rows: &[MethodMetrics<'_>]) -> Table {
        let mut table = Table::builder(title, rows).text("method", |row| &row.method);
        for metric in Metric::ALL {
            let column = |name: &str| Column { name: name.into(), group: Some(metric.to_string()), is_number: true };
            table = table
                .column(column(&metric.to_string()), |row| or(MISSING, row.ours.get(&metric)))
                .column(column("paper"), |row| or(NOT_GIVEN, row.papers.get(&metric)))
                .column(column("difference"), |row| {
                    or(NOT_GIVEN, row.difference(metric).map(|points| format!("{points:+.1}")))
                });
        }
        table
            .number("runs", |row| self.runs(&row.method, row.runs()))
            .number("cells", |row| match row.method.external {
                true => NOT_GIVEN.to_owned(),
                false => format!("{}/{}", row.done, row.cells),
            })
            .build()
    }

    /// Returns the table of interquartile means and optimality gaps with their intervals; `None` if no method has such
    /// numbers.
    pub(super) fn iqm_table(&self) -> Option<Table> {
        let title = "Interquartile means and optimality gaps: over all environments and the runs that all of them have, with \
                     95 % stratified bootstrap intervals. If configurations were selected, a second interval repeats the \
                     selection in each resample. The gap is the mean distance of success rates from 100 %";
        let mut table = Table::builder(title, &self.averages).text("method", |row| &row.method);
        for metric in Metric::ALL {
            let column = |name: &str| Column { name: name.into(), group: Some(metric.to_string()), is_number: true };
            let anew = move |row: &MethodMetrics<'_>| {
                let [low, high] = row.reselected.get(&metric)?[0].interval_95?;
                Some(format!("[{:.1}, {:.1}]", low + 0.0, high + 0.0)) // no negative zero
            };
            table = table.column(column("IQM"), move |row| or(MISSING, row.iqms.get(&metric)));
            if self.averages.iter().any(|row| !row.reselected.is_empty()) {
                table = table.column(column("selection anew"), move |row| or(NOT_GIVEN, anew(row)));
            }
            table = table.column(column("gap"), move |row| or(MISSING, row.gaps.get(&metric)));
        }
        let table = table.number("runs", |row| self.runs(&row.method, row.iqm_runs())).build();
        let is_known = self.averages.iter().any(|row| !row.iqms.is_empty() || !row.gaps.is_empty());
        is_known.then_some(table)
    }

    /// Returns a table for each environment with the success rates in all tests: the nine scenarios, and tests on other
    /// sets.
    pub(super) fn scenario_tables(&self) -> Vec<Table> {
        let table = |rows: &[ScenarioRow<'_, '_>]| {
            let title =
                format!("{}: success in each test, with 95 % Wilson intervals of all episodes", rows[0].0.environment);
            let mut table = Table::builder(title, rows)
                .text("method", |(row, _)| &row.method)
                .text("trained on", |(_, train)| train);
            let is_known = |name: &&&str| {
                version(name).is_some() || rows.iter().any(|(row, train)| counted(row, *train, name).episodes > 0)
            };
            for &test in self.scope.tested_on.iter().filter(is_known) {
                table = table.number(format!("on {test}"), move |(row, train)| {
                    let rate = row.test(*train, test, |test| test.success_percent);
                    let interval = counted(row, *train, test).known();
                    let shown = |(rate, [low, high]): (Summary, [f64; 2])| format!("{rate} [{low:.1}, {high:.1}]");
                    Entry { heat: rate.map(|rate| rate.mean), ..or(MISSING, rate.zip(interval).map(shown)) }
                });
            }
            table.build()
        };
        self.scenario_rows().chunk_by(|a, b| a.0.environment == b.0.environment).map(table).collect()
    }

    /// Returns a row for each environment, method and training distribution.
    pub(super) fn scenario_rows(&self) -> Vec<ScenarioRow<'_, '_>> {
        let of = |row| trained_on(row).into_iter().map(move |train| (row, train));
        self.selections.iter().flat_map(of).collect()
    }

    /// Returns the tests to list for a row. For agents that were trained outside of the experiment, lists only tests
    /// that were run.
    pub(super) fn tests_of<'r>(
        &'r self,
        (row, train): ScenarioRow<'r, 'r>,
    ) -> Vec<(&'r MethodResults<'r>, TrainedOn<'r>, &'r str)> {
        let is_there = |name: &&str| !row.method.external || counted(row, train, name).episodes > 0;
        self.scope.tested_on.iter().copied().filter(is_there).map(|name| (row, train, name)).collect()
    }

    /// Formats a number of runs. If the plan has more runs, adds their number, e.g. "2 of 5".
    fn runs(&self, method: &Method, runs: usize) -> String {
        let all = self.plan.runs;
        if method.external || runs == all as usize { runs.to_string() } else { format!("{runs} of {all}") }
    }
}

/// Returns the text of `shown`, or `otherwise` if it is `None`.
fn or(otherwise: &str, shown: Option<impl ToString>) -> Entry {
    shown.map_or_else(|| otherwise.to_owned(), |shown| shown.to_string()).into()
}
