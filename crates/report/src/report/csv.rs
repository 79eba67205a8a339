//! CSV files of a report. An empty field is a missing number.

use perturb_protocol::Version;
use perturb_records::statistics::Bootstrapped;
use perturb_records::{Metric, Scenario};
use perturb_text::Table;

use super::columns::MethodColumns;
use super::index::has_scenarios_of;
use super::numbers::{MethodMetrics, counted, or_empty};
use super::{Cell, Report};

/// New and old names of files. The old names are written as well until version 0.3.
const RENAMED: [(&str, &str); 5] = [
    ("cvar.csv", "worst.csv"),
    ("evaluations.csv", "marks.csv"),
    ("external.csv", "elsewhere.csv"),
    ("sample_efficiency.csv", "footing.csv"),
    ("train_r_vs_d.csv", "gains.csv"),
];

/// Returns the name that a file of a report had before version 0.2, if it was another one.
pub fn old_file_name(name: &str) -> Option<&'static str> {
    RENAMED.iter().find(|(new, _)| *new == name).map(|(_, old)| *old)
}

impl Report<'_> {
    /// Returns the files that a report has beside its documents, by their titles. Write each also under its
    /// [`old_file_name`].
    pub fn files(&self) -> Vec<Table> {
        let sets = (!self.set_tests.is_empty()).then(|| self.sets_file());
        let tuned = (!self.tuned.is_empty()).then(|| self.tuned_file());
        let files =
            [self.finding_file(), self.metrics_file(), self.iqm_file(), self.scenarios_file(), self.selected_file()];
        let elsewhere = (!self.elsewhere.is_empty()).then(|| self.elsewhere_file());
        let marks = (!self.marks.is_empty()).then(|| self.marks_file());
        let more = [
            self.comparisons_file(),
            self.gains_file(),
            self.profiles_file(),
            self.footing_file(),
            self.worst_file(),
            self.parameters_file(),
            self.thresholds_file(),
            self.settings_file(),
            self.configurations_file(),
        ];
        let more = more.into_iter().filter(|table| !table.rows.is_empty());
        files.into_iter().chain(elsewhere).chain(sets).chain(tuned).chain(marks).chain(more).collect()
    }

    fn metrics_file(&self) -> Table {
        let rows = self.metrics.iter().chain(&self.averages);
        let lines: Vec<_> = rows.flat_map(|row| Metric::ALL.map(|metric| (row, metric))).collect();
        let mut table = Table::builder("metrics.csv", &lines)
            .text("environment", |(row, _)| row.environment)
            .method(|(row, _)| &row.method)
            .text("metric", |(_, metric)| metric)
            .summary(|(row, metric)| row.ours.get(metric).copied());
        if self.has_ties() {
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

    fn iqm_file(&self) -> Table {
        let of_method = self
            .averages
            .iter()
            .flat_map(|row| Metric::ALL.map(|metric| (row, metric, row.iqms.get(&metric), row.gaps.get(&metric))));
        let low = |number: Option<&Bootstrapped>| or_empty(number.and_then(|number| Some(number.interval_95?[0])));
        let high = |number: Option<&Bootstrapped>| or_empty(number.and_then(|number| Some(number.interval_95?[1])));
        let lines: Vec<_> = of_method.collect();
        let reselected = |line: &(&MethodMetrics<'_>, Metric, _, _), which: usize| {
            line.0.reselected.get(&line.1).map(|both| both[which])
        };
        Table::builder("iqm.csv", &lines)
            .method(|(row, ..)| &row.method)
            .text("metric", |(_, metric, ..)| metric)
            .number("runs", |(.., iqm, _)| iqm.map_or(0, |iqm| iqm.runs))
            .number("iqm", |(.., iqm, _)| or_empty(iqm.map(|iqm| iqm.point)))
            .number("low_95", move |(.., iqm, _)| low(*iqm))
            .number("high_95", move |(.., iqm, _)| high(*iqm))
            .number("optimality_gap", |(.., gap)| or_empty(gap.map(|gap| gap.point)))
            .number("gap_low_95", move |(.., gap)| low(*gap))
            .number("gap_high_95", move |(.., gap)| high(*gap))
            .number("selection_low_95", move |line| low(reselected(line, 0).as_ref()))
            .number("selection_high_95", move |line| high(reselected(line, 0).as_ref()))
            .number("gap_selection_low_95", move |line| low(reselected(line, 1).as_ref()))
            .number("gap_selection_high_95", move |line| high(reselected(line, 1).as_ref()))
            .build()
    }

    fn scenarios_file(&self) -> Table {
        let (trained, tested) = (self.trained_versions(), self.tested_versions());
        let of_selection = |selection| Scenario::pairs(&trained, &tested).map(move |scenario| (selection, scenario));
        let lines = self.with_scenarios().into_iter().flat_map(of_selection);
        let lines: Vec<_> = lines.filter(|(row, scenario)| has_scenarios_of(row, scenario.train)).collect();
        Table::builder("scenarios.csv", &lines)
            .text("environment", |(selection, _)| selection.environment)
            .method(|(selection, _)| &selection.method)
            .text("train", |(_, scenario)| scenario.train)
            .text("test", |(_, scenario)| scenario.test)
            .summary(|(selection, scenario)| selection.scenario(*scenario))
            .number("episodes", |(selection, scenario)| counted(selection, *scenario).episodes)
            .number("low_95", |(selection, scenario)| or_empty(counted(selection, *scenario).known().map(|it| it[0])))
            .number("high_95", |(selection, scenario)| or_empty(counted(selection, *scenario).known().map(|it| it[1])))
            .build()
    }

    fn sets_file(&self) -> Table {
        Table::builder("sets.csv", &self.set_tests)
            .text("environment", |test| test.environment)
            .method(|test| test.method)
            .text("train", |test| test.trained_on)
            .text("test", |test| test.tested_on)
            .summary(|test| test.success)
            .number("mean_return", |test| or_empty(test.mean_return.map(|summary| summary.mean)))
            .build()
    }

    fn marks_file(&self) -> Table {
        Table::builder("evaluations.csv", &self.marks)
            .text("environment", |test| test.environment)
            .method(|test| test.method)
            .text("train", |test| test.trained_on)
            .number("episodes", |test| test.episodes)
            .text("test", |test| test.tested_on)
            .summary(|test| test.success)
            .number("mean_return", |test| or_empty(test.mean_return.map(|summary| summary.mean)))
            .build()
    }

    fn tuned_file(&self) -> Table {
        Table::builder("tuning.csv", &self.tuned)
            .text("environment", |tuned| tuned.environment)
            .method(|tuned| &tuned.method)
            .text("train", |tuned| tuned.trained_on)
            .number("cells", |tuned| tuned.cells)
            .number("done", |tuned| tuned.done)
            .number("failed", |tuned| tuned.failed)
            .text("cell", |tuned| or_empty(tuned.chosen.map(|chosen| &chosen.cell.id)))
            .number("seeds", |tuned| tuned.chosen.map_or(0, |chosen| chosen.seeds))
            .number("success_mean", |tuned| or_empty(tuned.chosen.map(|chosen| chosen.success_percent)))
            .number("return_mean", |tuned| or_empty(tuned.chosen.map(|chosen| chosen.mean_return)))
            .text("settings", |tuned| {
                let settings = |cell: &Cell| {
                    let written = cell.config.table().into_iter().filter(|(key, _)| key != "seed");
                    written.map(|(key, value)| format!("{key}={value}")).collect::<Vec<_>>().join(" ")
                };
                or_empty(tuned.chosen.map(|chosen| settings(chosen.cell)))
            })
            .build()
    }

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
            .text("command", |selected| &selected.result.command)
            .build()
    }
}
