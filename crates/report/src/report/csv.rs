//! The CSV files of a report. A missing number is an empty field.

use perturb_protocol::Version;
use perturb_records::Metric;
use perturb_records::statistics::Bootstrapped;
use perturb_text::Table;

use super::Report;
use super::columns::MethodColumns;
use super::numbers::{MethodMetrics, counted, or_empty};

/// A function that reads one of a method's bootstrapped numbers.
type BootstrappedOf = fn(&MethodMetrics<'_>, Metric) -> Option<Bootstrapped>;

impl Report<'_> {
    /// Returns the CSV files of the report, except those of its pictures. The title of each table is its file name.
    pub fn files(&self) -> Vec<Table> {
        let rows: Vec<_> = self.metrics.iter().chain(&self.averages).collect();
        let more = [self.comparisons_file(), self.parameters_file()].into_iter().filter(|file| !file.rows.is_empty());
        let files = [metrics_file("metrics.csv", &rows), self.iqm_file(), self.scenarios_file(), self.selected_file()];
        files.into_iter().chain(more).collect()
    }

    /// Returns the file `iqm.csv`: interquartile means and optimality gaps over all environments.
    fn iqm_file(&self) -> Table {
        let rows = self.averages.iter().flat_map(|row| Metric::ALL.map(|metric| (row, metric)));
        let lines: Vec<(&MethodMetrics<'_>, Metric)> = rows.collect();
        let mut table = Table::builder("iqm.csv", &lines)
            .method(|(row, _)| &row.method)
            .text("metric", |(_, metric)| metric)
            .number("runs", |(row, metric)| row.iqms.get(metric).map_or(0, |iqm| iqm.runs))
            .number("iqm", |(row, metric)| or_empty(row.iqms.get(metric).map(|iqm| iqm.point)))
            .number("optimality_gap", |(row, metric)| or_empty(row.gaps.get(metric).map(|gap| gap.point)));
        let numbers: [(&str, BootstrappedOf); 4] = [
            ("", |row, metric| row.iqms.get(&metric).copied()),
            ("gap_", |row, metric| row.gaps.get(&metric).copied()),
            ("selection_", |row, metric| row.reselected.get(&metric).map(|both| both[0])),
            ("gap_selection_", |row, metric| row.reselected.get(&metric).map(|both| both[1])),
        ];
        for (prefix, number) in numbers {
            for (index, end) in ["low", "high"].into_iter().enumerate() {
                table = table.number(format!("{prefix}{end}_95"), move |(row, metric)| {
                    or_empty(number(row, *metric).and_then(|number| Some(number.interval_95?[index])))
                });
            }
        }
        table.build()
    }

    /// Returns the file `scenarios.csv`: success and return in each test.
    fn scenarios_file(&self) -> Table {
        let lines: Vec<_> = self.scenario_rows().into_iter().flat_map(|row| self.tests_of(row)).collect();
        Table::builder("scenarios.csv", &lines)
            .text("environment", |(row, ..)| row.environment)
            .method(|(row, ..)| &row.method)
            .text("train", |(_, train, _)| train)
            .text("test", |(.., test)| test)
            .summary(|(row, train, test)| row.test(*train, test, |test| test.success_percent))
            .number("episodes", |(row, train, test)| counted(row, *train, test).episodes)
            .number("low_95", |(row, train, test)| or_empty(counted(row, *train, test).known().map(|it| it[0])))
            .number("high_95", |(row, train, test)| or_empty(counted(row, *train, test).known().map(|it| it[1])))
            .number("mean_return", |(row, train, test)| {
                or_empty(row.test(*train, test, |test| test.mean_return).map(|summary| summary.mean))
            })
            .build()
    }

    /// Returns the file `selected.csv`: the selected cells.
    fn selected_file(&self) -> Table {
        Table::builder("selected.csv", &self.selected())
            .text("environment", |selected| &selected.result.training.environment)
            .method(|selected| &selected.result.training.method)
            .text("train", |selected| selected.cell.trained_on())
            .text("run", |selected| selected.cell.run)
            .text("seed", |selected| selected.result.training.seed)
            .text("cell", |selected| &selected.cell.id)
            .number("success_d", |selected| or_empty(selected.rate(Version::D)))
            .number("success_r", |selected| or_empty(selected.rate(Version::R)))
            .number("success_e", |selected| or_empty(selected.rate(Version::E)))
            .text("commit", |selected| selected.result.commits().collect::<Vec<_>>().join("; "))
            .build()
    }
}

/// Returns the file of each method's three metrics, with t intervals of the means and the paper's numbers. `name` is
/// the file's name.
pub(super) fn metrics_file(name: &str, rows: &[&MethodMetrics<'_>]) -> Table {
    let lines: Vec<_> = rows.iter().flat_map(|row| Metric::ALL.map(|metric| (*row, metric))).collect();
    let end = |(row, metric): &(&MethodMetrics<'_>, Metric), end: usize| {
        or_empty(row.means.get(metric).and_then(|mean| Some(mean.interval_95?[end])))
    };
    let mut table = Table::builder(name, &lines)
        .text("environment", |(row, _)| row.environment)
        .method(|(row, _)| &row.method)
        .text("metric", |(_, metric)| metric)
        .summary(|(row, metric)| row.ours.get(metric).copied())
        .number("low_95", move |line| end(line, 0))
        .number("high_95", move |line| end(line, 1));
    if rows.iter().any(|row| !row.ties.is_empty()) {
        table = table
            .number("tied_choices", |(row, metric)| row.ties.get(metric).map_or(1, |range| range.choices))
            .number("ties_low", |(row, metric)| or_empty(row.ties.get(metric).map(|range| range.low)))
            .number("ties_high", |(row, metric)| or_empty(row.ties.get(metric).map(|range| range.high)));
    }
    table
        .number("paper_mean", |(row, metric)| or_empty(row.papers.get(metric).map(|paper| paper.mean)))
        .number("paper_std", |(row, metric)| or_empty(row.papers.get(metric).and_then(|paper| paper.std)))
        .number("difference", |(row, metric)| or_empty(row.difference(*metric)))
        .build()
}
