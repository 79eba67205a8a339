//! The numbers of a report as tables for reading.

use std::collections::BTreeMap;

use perturb_experiment::{MethodResults, distinct};
use perturb_protocol::Version;
use perturb_records::statistics::{Bootstrapped, Summary};
use perturb_records::{Metric, Scenario, TrainedOn, versions};
use perturb_settings::Method;
use perturb_text::{Column, Entry, Table};

use super::index::{has_scenarios, has_scenarios_of};
use super::numbers::{MethodMetrics, counted};
use super::{GeneralizationPoint, MISSING, Report};

/// The text for a number that the paper does not have.
const NOT_GIVEN: &str = "–";

impl Report<'_> {
    /// The three metrics, averaged where there are several environments, and of each.
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

    fn metrics_table(&self, title: String, rows: &[MethodMetrics<'_>]) -> Table {
        let mut table = Table::builder(title, rows).text("method", |row| &row.method);
        for metric in Metric::ALL {
            let column = |name: &str| Column { name: name.into(), group: Some(metric.to_string()), is_number: true };
            table = table
                .column(column(&metric.to_string()), |row| rate(row.ours.get(&metric).copied()))
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

    /// Whether a number is a mean over tied configurations.
    pub(super) fn has_ties(&self) -> bool {
        self.metrics.iter().any(|row| !row.ties.is_empty())
    }

    /// The numbers that are means over tied configurations, with their ranges; `None` without ties.
    pub(super) fn ties_table(&self) -> Option<Table> {
        let rows = self.averages.iter().filter(|_| self.scope.averaged.len() > 1).chain(&self.metrics);
        let rows: Vec<_> =
            rows.flat_map(|row| row.ties.iter().map(move |(metric, range)| (row, metric, range))).collect();
        rows.first()?;
        let title = "Means over configurations that tie in the selecting test, and their range from the lowest to the \
                     highest choice in every run";
        let table = Table::builder(title, &rows)
            .text("environment", |(row, ..)| row.environment)
            .text("method", |(row, ..)| &row.method)
            .text("metric", |(_, metric, _)| metric)
            .number("choices", |(.., range)| range.choices)
            .number("mean", |(row, metric, _)| or(MISSING, row.ours.get(metric).map(|it| format!("{:.1}", it.mean))))
            .number("range", |(.., range)| format!("{:.1} … {:.1}", range.low, range.high))
            .build();
        Some(table)
    }

    pub(super) fn iqm_table(&self) -> Option<Table> {
        let title = "Interquartile mean over all environments and the runs that all of them have, with its 95 % stratified \
                     bootstrap interval, and the interval with every selection made anew in each resample";
        self.aggregate_table(title, |row| &row.iqms, 0)
    }

    pub(super) fn gap_table(&self) -> Option<Table> {
        let title = "Optimality gap: how far success rates stay below 100 % on average, over the same runs and with the same \
                     intervals; lower is better";
        self.aggregate_table(title, |row| &row.gaps, 1)
    }

    /// `reselected` is the place of the number among those with selections made anew.
    fn aggregate_table(
        &self,
        title: &str,
        numbers: for<'m> fn(&'m MethodMetrics<'_>) -> &'m BTreeMap<Metric, Bootstrapped>,
        reselected: usize,
    ) -> Option<Table> {
        let mut table = Table::builder(title, &self.averages).text("method", |row| &row.method);
        for metric in Metric::ALL {
            let interval = move |row: &MethodMetrics<'_>| {
                let [low, high] = row.reselected.get(&metric)?[reselected].interval_95?;
                Some(format!("[{:.1}, {:.1}]", low + 0.0, high + 0.0)) // no negative zero
            };
            table = table
                .number(metric.to_string(), move |row| or(MISSING, numbers(row).get(&metric)))
                .number("selection anew", move |row| or(NOT_GIVEN, interval(row)));
        }
        let table = table.number("runs", |row| self.runs(&row.method, row.iqm_runs())).build();
        (!table.rows.is_empty()).then_some(table)
    }

    /// Extrapolation of each environment, and what it is the geometric mean of.
    pub(super) fn extrapolation_tables(&self) -> Vec<Table> {
        let table = |selections: &[&MethodResults<'_>]| {
            let title = format!(
                "{}: Extrapolation and the three that it is the geometric mean of, with 95 % Wilson intervals",
                selections[0].environment
            );
            let mut table = Table::builder(title, selections).text("method", |selection| &selection.method);
            for scenario in Metric::EXTRAPOLATION {
                table = table.number(scenario.to_string(), move |selection| {
                    let counted = counted(selection, scenario);
                    let shown = |[low, high]: [f64; 2]| format!("{:.1} [{low:.1}, {high:.1}]", counted.rate());
                    or(MISSING, counted.known().map(shown))
                });
            }
            let metric = Metric::Extrapolation;
            table
                .number(metric.to_string(), move |selection| or(MISSING, selection.summary(metric)))
                .number("runs", move |selection| self.runs(&selection.method, selection.metric(metric).len()))
                .build()
        };
        self.with_scenarios().chunk_by(|a, b| a.environment == b.environment).map(table).collect()
    }

    /// The nine scenarios of each environment, and those of R+E.
    pub(super) fn scenario_tables(&self) -> Vec<Table> {
        let (trained, tested) = (self.trained_versions(), self.tested_versions());
        let more = if trained.len() + tested.len() > 2 * Version::ALL.len() { ", and R+E for reference" } else { "" };
        let table = |selections: &[&MethodResults<'_>]| {
            let pairs = selections.iter().flat_map(|row| trained.iter().map(move |&train| (*row, train)));
            let rows: Vec<(&MethodResults<'_>, Version)> =
                pairs.filter(|(row, train)| has_scenarios_of(row, *train)).collect();
            let mut table = Table::builder(format!("{}: the nine scenarios{more}", rows[0].0.environment), &rows)
                .text("method", |(selection, _)| &selection.method)
                .text("trained on", |(_, train)| train);
            for &test in &tested {
                let name = if test == Version::D { format!("tested on {test}") } else { format!("on {test}") };
                table = table.number(name, |&(selection, train)| rate(selection.scenario(Scenario { train, test })));
            }
            table.build()
        };
        self.with_scenarios().chunk_by(|a, b| a.environment == b.environment).map(table).collect()
    }

    /// The rows that have places among the scenarios.
    pub(super) fn with_scenarios(&self) -> Vec<&MethodResults<'_>> {
        self.selections.iter().filter(|row| has_scenarios(row)).collect()
    }

    /// The paper's, and R+E if the plan trains on it.
    pub(super) fn trained_versions(&self) -> Vec<Version> {
        let runs = || self.selections.iter().flat_map(|selection| selection.runs.values());
        versions(|version| runs().any(|run| run.selected.contains_key(&TrainedOn::Version(version))))
    }

    /// The paper's, and R+E if the plan tests on it.
    pub(super) fn tested_versions(&self) -> Vec<Version> {
        versions(|version| self.scope.tested_on.contains(&version.to_string().as_str()))
    }

    /// `None` if the plan has no sets of its own.
    pub(super) fn set_table(&self) -> Option<Table> {
        let title = "Tests that are no scenario: on own sets of parameters, or of policies trained on one, or on what is not known";
        let table = Table::builder(title, &self.set_tests)
            .text("environment", |test| test.environment)
            .text("method", |test| test.method)
            .text("trained on", |test| test.trained_on)
            .text("tested on", |test| test.tested_on)
            .number("success, %", |test| rate(test.success))
            .number("mean return", |test| or(MISSING, test.mean_return))
            .number("runs", |test| self.runs(test.method, test.success.map_or(0, |summary| summary.runs)))
            .build();
        (!table.rows.is_empty()).then_some(table)
    }

    /// `None` if only the last policies were tested.
    pub(super) fn marks_table(&self) -> Option<Table> {
        let title = "Generalisation against training: success after so many episodes (evaluations.csv has the returns)";
        let of_moment = |a: &GeneralizationPoint<'_>, b: &GeneralizationPoint<'_>| {
            (a.environment, a.method, a.trained_on, a.episodes) == (b.environment, b.method, b.trained_on, b.episodes)
        };
        let moments: Vec<&[GeneralizationPoint<'_>]> = self.marks.chunk_by(of_moment).collect();
        let mut table = Table::builder(title, &moments)
            .text("environment", |tests| tests[0].environment)
            .text("method", |tests| tests[0].method)
            .text("trained on", |tests| tests[0].trained_on)
            .number("episodes", |tests| tests[0].episodes);
        for name in distinct(self.marks.iter().map(|test| test.tested_on)) {
            table = table.number(format!("on {name}"), |tests| {
                rate(tests.iter().find(|test| test.tested_on == name).and_then(|test| test.success))
            });
        }
        let table = table.build();
        (!table.rows.is_empty()).then_some(table)
    }

    /// `None` if nothing was tuned.
    pub(super) fn tuned_table(&self) -> Option<Table> {
        let title = "What was selected, by selection episodes on tuning seeds (tuning.csv has the configurations)";
        let table = Table::builder(title, &self.tuned)
            .text("environment", |tuned| tuned.environment)
            .text("method", |tuned| &tuned.method)
            .text("trained on", |tuned| tuned.trained_on)
            .text("first tuning cell", |tuned| or(MISSING, tuned.chosen.map(|chosen| &chosen.cell.id)))
            .number("success, %", |tuned| {
                or(MISSING, tuned.chosen.map(|chosen| format!("{:.1}", chosen.success_percent)))
            })
            .number("mean return", |tuned| or(MISSING, tuned.chosen.map(|chosen| format!("{:.1}", chosen.mean_return))))
            .number("seeds", |tuned| tuned.chosen.map_or(0, |chosen| chosen.seeds))
            .number("cells", |tuned| format!("{}/{}", tuned.done, tuned.cells))
            .number("failed", |tuned| tuned.failed)
            .build();
        (!table.rows.is_empty()).then_some(table)
    }

    /// `None` of a report without cells.
    pub(super) fn selected_table(&self) -> Option<Table> {
        if self.plan.cells.is_empty() {
            return None;
        }
        let title =
            "Where the numbers come from: the selected cell of each run (selected.csv has its settings and command)";
        let table = Table::builder(title, &self.selected())
            .text("environment", |selected| &selected.result.training.environment)
            .text("method", |selected| &selected.result.training.method)
            .text("trained on", |selected| selected.cell.trained_on())
            .text("run", |selected| selected.cell.run)
            .text("seed", |selected| selected.result.training.seed)
            .text("cell", |selected| &selected.cell.id)
            .number("success on it", |selected| {
                or(MISSING, selected.own_test().map(|test| format!("{:.1}", test.success_percent)))
            })
            .build();
        Some(table)
    }

    /// `None` if no cell failed.
    pub(super) fn failure_table(&self) -> Option<Table> {
        let table = Table::builder("Failed cells", &self.failures)
            .text("cell", |failure| &failure.id)
            .text("reason", |failure| &failure.reason)
            .build();
        (!table.rows.is_empty()).then_some(table)
    }

    fn runs(&self, method: &Method, runs: usize) -> String {
        let all = self.plan.runs;
        if method.external || runs == all as usize { runs.to_string() } else { format!("{runs} of {all}") }
    }
}

fn rate(summary: Option<Summary>) -> Entry {
    Entry { heat: summary.map(|summary| summary.mean), ..or(MISSING, summary) }
}

fn or(otherwise: &str, shown: Option<impl ToString>) -> Entry {
    shown.map_or_else(|| otherwise.to_owned(), |shown| shown.to_string()).into()
}
