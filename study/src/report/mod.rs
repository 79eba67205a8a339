//! Tables of an experiment's results, beside the paper's.
//!
//! [`Report::new`] makes the tables; [`text`] prints them, [`markdown`] and [`html`] turn them into documents, and
//! [`csv`](csv_files) has the numbers. Nothing in them depends on when, where or in how many attempts the cells were
//! done.

mod csv;
mod figures;
mod html;
mod render;

use super::plan::{Cell, Method};
use super::selection::{Group, Metric, Results, average, interquartile};
use super::statistics::{Iqm, Summary};
use crate::{Scenario, Version, paper};

pub use csv::csv_files;
pub use figures::{Figure, FigureData, FigureError, Figures};
pub use html::html;
pub use render::{markdown, text};

/// Resamples of each bootstrap, as many as rliable takes.
const RESAMPLES: usize = 50_000;
/// The paper's budgets.
const PAPER_EPISODES: u64 = 15_000;
const PAPER_TEST_EPISODES: u64 = 1000;
/// What stands for a number that there is not.
pub const MISSING: &str = "missing";
/// What stands for a number that the paper does not have.
const NOT_GIVEN: &str = "–";

/// All tables.
#[derive(Clone, Debug)]
pub struct Report {
    /// What was done, in sentences.
    pub overview: Vec<String>,
    /// The three metrics, of each environment and averaged.
    pub metrics: Vec<Table>,
    /// Interquartile means.
    pub iqm: Table,
    /// The nine scenarios of each environment.
    pub scenarios: Vec<Table>,
    /// Which cells the numbers come from.
    pub selected: Table,
    /// Cells that failed; empty if none has.
    pub failures: Table,
}

/// A table.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// Names of the columns.
    pub header: Vec<String>,
    /// Names of neighbouring columns together, with their number, where one name is not enough; empty otherwise.
    pub spans: Vec<(String, usize)>,
    /// How many of the first columns are texts; the others are numbers.
    pub texts: usize,
    /// The rows, each as long as the header.
    pub rows: Vec<Vec<Entry>>,
}

/// An entry of a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// As it is shown.
    pub text: String,
    /// A share in percent that may be shown by a colour.
    pub heat: Option<f64>,
}

impl From<String> for Entry {
    fn from(text: String) -> Self {
        Self { text, heat: None }
    }
}

impl From<&str> for Entry {
    fn from(text: &str) -> Self {
        text.to_owned().into()
    }
}

/// The paper's number beside one of ours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PaperCell {
    /// Mean, %.
    pub(super) mean: f64,
    /// Standard deviation, %; not known for averages over other environments than the paper's six.
    pub(super) std: Option<f64>,
}

impl Report {
    /// The tables of `results`, of which `groups` were selected.
    pub fn new(results: &Results<'_>, groups: &[Group]) -> Self {
        let environments = results.plan.environments();
        let of_environment =
            |name: &str| -> Vec<&Group> { groups.iter().filter(|group| group.environment == name).collect() };
        let mut metrics: Vec<Table> = Vec::new();
        if environments.len() > 1 {
            metrics.push(averages(results, groups));
        }
        metrics.extend(environments.iter().map(|name| metrics_of(name, &of_environment(name), results.plan.runs)));
        Self {
            overview: overview(results, groups),
            metrics,
            iqm: iqm(results, groups),
            scenarios: environments.iter().map(|name| scenarios_of(name, &of_environment(name))).collect(),
            selected: selected(results, groups),
            failures: failures(results),
        }
    }

    /// All tables in the order of reading.
    pub fn tables(&self) -> impl Iterator<Item = &Table> {
        let failures = (!self.failures.rows.is_empty()).then_some(&self.failures);
        self.metrics.iter().chain([&self.iqm]).chain(&self.scenarios).chain([&self.selected]).chain(failures)
    }
}

fn overview(results: &Results<'_>, groups: &[Group]) -> Vec<String> {
    let (cells, done, failed) = (results.plan.cells.len(), results.done(), results.failures().count());
    let mut lines =
        vec![format!("{done} of {cells} cells are done, {failed} failed, {} are missing.", cells - done - failed)];
    lines.extend(budgets(results));
    let incomplete = groups.iter().filter(|group| group.done < group.cells).count();
    if incomplete > 0 {
        lines.push(format!(
            "{incomplete} of {} rows lack cells, so that their configurations were selected among fewer than the plan \
             has; the column `cells` says which.",
            groups.len()
        ));
    }
    let results = (0..cells).filter_map(|index| results.result(index));
    let commits: std::collections::BTreeSet<&str> = results.flat_map(|result| result.commits()).collect();
    if !commits.is_empty() {
        lines.push(format!("Done by perturb {}.", commits.into_iter().collect::<Vec<_>>().join(", ")));
    }
    lines.push(
        "Numbers are success rates in percent: mean ± standard deviation over runs; one run has none. The paper's \
         are those of its five runs; a difference is ours less the paper's. Hopper and HalfCheetah run on another physics engine than the \
         paper's."
            .into(),
    );
    lines
}

/// Budgets that are not the paper's.
fn budgets(results: &Results<'_>) -> Option<String> {
    let range = |of: &dyn Fn(&Cell) -> u64| {
        let (least, most) = results.plan.cells.iter().map(of).fold((u64::MAX, 0), |(l, m), n| (l.min(n), m.max(n)));
        (least, most, if least == most { least.to_string() } else { format!("{least} to {most}") })
    };
    let (trained, tested) = (range(&|cell| cell.config.common.episodes), range(&|cell| cell.tests.episodes));
    let same = |range: &(u64, u64, String), paper: u64| (range.0, range.1) == (paper, paper);
    if same(&trained, PAPER_EPISODES) && same(&tested, PAPER_TEST_EPISODES) {
        return None;
    }
    Some(format!(
        "Other budgets than the paper's: {} episodes in a training, where the paper has {PAPER_EPISODES}, and {} in a \
         test, where it has {PAPER_TEST_EPISODES}.",
        trained.2, tested.2
    ))
}

fn metrics_of(environment: &str, groups: &[&Group], runs: u32) -> Table {
    let row = |group: &&Group| {
        let cells = format!("{}/{}", group.done, group.cells);
        metrics_row(
            &group.method,
            runs,
            cells,
            |metric| group.summary(metric),
            |metric| paper_cell(environment, &group.method, metric),
        )
    };
    metrics_table(environment.to_owned(), groups.iter().map(row).collect())
}

fn metrics_table(title: String, rows: Vec<Vec<Entry>>) -> Table {
    let mut header = vec!["method".to_owned()];
    header.extend(Metric::ALL.iter().flat_map(|metric| [metric.to_string(), "paper".into(), "difference".into()]));
    header.extend(["runs".into(), "cells".into()]);
    let ours_and_papers = Metric::ALL.map(|metric| (metric.to_string(), 3));
    let spans = [(String::new(), 1)].into_iter().chain(ours_and_papers).chain([(String::new(), 2)]).collect();
    Table { title, header, spans, texts: 1, rows }
}

fn metrics_row(
    method: &Method,
    runs: u32,
    cells: String,
    ours: impl Fn(Metric) -> Option<Summary>,
    paper: impl Fn(Metric) -> Option<PaperCell>,
) -> Vec<Entry> {
    let mut row: Vec<Entry> = vec![method.to_string().into()];
    let mut least = usize::MAX;
    for metric in Metric::ALL {
        let (ours, paper) = (ours(metric), paper(metric));
        least = least.min(ours.map_or(0, |summary| summary.runs));
        row.push(shown(ours));
        row.push(paper.map_or_else(|| NOT_GIVEN.to_owned(), |cell| cell.to_string()).into());
        let difference = ours.zip(paper).map(|(ours, paper)| format!("{:+.1}", ours.mean - paper.mean));
        row.push(difference.unwrap_or_else(|| NOT_GIVEN.to_owned()).into());
    }
    row.push(if least == runs as usize { runs.to_string() } else { format!("{least} of {runs}") }.into());
    row.push(cells.into());
    row
}

/// Averages over the plan's environments.
fn averages(results: &Results<'_>, groups: &[Group]) -> Table {
    let environments = results.plan.environments();
    let row = |method: &Method| {
        let of_method = by_environment(groups, method, &environments);
        let ours = |metric| average(&of_method.clone()?, metric);
        let paper = |metric| paper_average(&environments, method, metric);
        let (done, cells) = groups
            .iter()
            .filter(|group| group.method == *method)
            .fold((0, 0), |(done, cells), group| (done + group.done, cells + group.cells));
        metrics_row(method, results.plan.runs, format!("{done}/{cells}"), ours, paper)
    };
    let title = format!("Average over {}", environments.join(", "));
    metrics_table(title, results.plan.methods().iter().map(row).collect())
}

/// The groups of a method in all `environments`; `None` if one is not in the plan.
pub(super) fn by_environment<'a>(
    groups: &'a [Group],
    method: &Method,
    environments: &[&str],
) -> Option<Vec<&'a Group>> {
    let find = |name: &&str| groups.iter().find(|group| group.environment == **name && group.method == *method);
    environments.iter().map(find).collect()
}

fn iqm(results: &Results<'_>, groups: &[Group]) -> Table {
    let environments = results.plan.environments();
    let row = |method: &Method| {
        let of_method = by_environment(groups, method, &environments);
        let numbers =
            Metric::ALL.map(|metric| of_method.as_ref().and_then(|groups| interquartile(groups, metric, RESAMPLES)));
        let entry = |number: &Option<(Iqm, usize)>| -> Entry {
            number.map_or_else(|| MISSING.to_owned(), |(iqm, _)| iqm.to_string()).into()
        };
        let runs = results.plan.runs;
        let least = numbers.iter().map(|number| number.map_or(0, |(_, runs)| runs)).min().unwrap_or_default();
        let least = if least == runs as usize { runs.to_string() } else { format!("{least} of {runs}") };
        let name = std::iter::once(method.to_string().into());
        name.chain(numbers.iter().map(entry)).chain(std::iter::once(least.into())).collect()
    };
    Table {
        title: "Interquartile mean over all environments and the runs that all of them have, with its 95 % stratified \
                bootstrap interval"
            .into(),
        header: std::iter::once("method".to_owned())
            .chain(Metric::ALL.map(|metric| metric.to_string()))
            .chain(std::iter::once("runs".to_owned()))
            .collect(),
        spans: Vec::new(),
        texts: 1,
        rows: results.plan.methods().iter().map(row).collect(),
    }
}

fn scenarios_of(environment: &str, groups: &[&Group]) -> Table {
    let row = |group: &Group, train: Version| {
        let tests = Version::ALL.map(|test| shown(group.scenario(Scenario { train, test })));
        [group.method.to_string().into(), train.to_string().into()].into_iter().chain(tests).collect()
    };
    Table {
        title: format!("{environment}: the nine scenarios"),
        header: ["method", "trained on", "tested on D", "on R", "on E"].map(str::to_owned).into(),
        spans: Vec::new(),
        texts: 2,
        rows: groups.iter().flat_map(|group| Version::ALL.map(|train| row(group, train))).collect(),
    }
}

fn selected(results: &Results<'_>, groups: &[Group]) -> Table {
    let mut rows = Vec::new();
    for group in groups {
        for (run, selected) in &group.runs {
            for (version, cell) in Version::ALL.into_iter().zip(selected.cells) {
                let Some(result) = cell.and_then(|cell| results.result(cell)) else { continue };
                let rate = selected.rates[version as usize][version as usize];
                rows.push(vec![
                    group.environment.as_str().into(),
                    group.method.to_string().into(),
                    version.to_string().into(),
                    run.to_string().into(),
                    result.training.seed.to_string().into(),
                    result.id.as_str().into(),
                    rate.map_or_else(|| MISSING.to_owned(), |rate| format!("{rate:.1}")).into(),
                ]);
            }
        }
    }
    Table {
        title: "Where the numbers come from: the selected cell of each run (selected.csv has its settings and command)"
            .into(),
        header: ["environment", "method", "trained on", "run", "seed", "cell", "success on it"]
            .map(str::to_owned)
            .into(),
        spans: Vec::new(),
        texts: 6,
        rows,
    }
}

fn failures(results: &Results<'_>) -> Table {
    let row = |failure: &super::folder::Failure| vec![failure.id.as_str().into(), failure.reason.as_str().into()];
    Table {
        title: "Failed cells".into(),
        header: ["cell", "reason"].map(str::to_owned).into(),
        spans: Vec::new(),
        texts: 2,
        rows: results.failures().map(row).collect(),
    }
}

fn shown(summary: Option<Summary>) -> Entry {
    match summary {
        Some(summary) => Entry { text: summary.to_string(), heat: Some(summary.mean) },
        None => MISSING.into(),
    }
}

/// The paper's number for a metric of a method; `None` if it has none.
pub(super) fn paper_cell(environment: &str, method: &Method, metric: Metric) -> Option<PaperCell> {
    let Method { algorithm, architecture, episodes_per_trial } = method;
    let row = paper::row_with_trials(environment, algorithm, architecture, *episodes_per_trial)?;
    let cell = match metric {
        Metric::Default => row.default,
        Metric::Interpolation => row.interpolation,
        Metric::Extrapolation => row.extrapolation,
    };
    Some(PaperCell { mean: cell.mean, std: Some(cell.std) })
}

/// The paper's average over `environments`: the published one if they are all six, otherwise the mean of theirs.
pub(super) fn paper_average(environments: &[&str], method: &Method, metric: Metric) -> Option<PaperCell> {
    let means: Vec<f64> =
        environments.iter().map(|name| Some(paper_cell(name, method, metric)?.mean)).collect::<Option<_>>()?;
    if means.len() == 6 {
        return paper_cell("Average", method, metric);
    }
    Some(PaperCell { mean: means.iter().sum::<f64>() / means.len() as f64, std: None })
}

impl std::fmt::Display for PaperCell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.std {
            Some(std) => f.pad(&format!("{:.1} ± {std:.1}", self.mean)),
            None => f.pad(&format!("{:.1}", self.mean)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Plan;

    fn overview_of(budgets: &str) -> String {
        let text =
            format!("environments = ['CartPole']\n{budgets}\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']");
        let plan = Plan::parse("test", text).unwrap();
        let states = vec![super::super::folder::CellState::Missing; plan.cells.len()];
        let results = Results { plan: &plan, states };
        let report = Report::new(&results, &results.select());
        assert_eq!(report.metrics[0].rows[0][1].text, MISSING, "nothing is done");
        assert!(report.scenarios[0].rows.iter().all(|row| row[2..].iter().all(|entry| entry.heat.is_none())));
        text_of(&report)
    }

    fn text_of(report: &Report) -> String {
        report.overview.join("\n")
    }

    #[test]
    fn other_budgets_than_the_papers_are_told() {
        assert!(!overview_of("").contains("budgets"));
        let told =
            "Other budgets than the paper's: 300 episodes in a training, where the paper has 15000, and 50 in a test";
        let text = overview_of("settings = { episodes = 300 }\ntest_episodes = 50");
        assert!(text.contains(told), "{text}");
        assert!(overview_of("test_episodes = 999").contains("999 in a test"));
    }

    #[test]
    fn the_papers_average_is_over_the_same_environments() {
        let method = Method { algorithm: "a2c".into(), architecture: "ff".into(), episodes_per_trial: None };
        let two = paper_average(&["CartPole", "MountainCar"], &method, Metric::Default).unwrap();
        assert!((two.mean - (100.0 + 79.78) / 2.0).abs() < 1e-9 && two.std.is_none());
        let six = ["Acrobot", "CartPole", "MountainCar", "Pendulum", "HalfCheetah", "Hopper"];
        let all = paper_average(&six, &method, Metric::Default).unwrap();
        assert_eq!((all.mean, all.std), (78.14, Some(6.07)));
        assert_eq!(paper_average(&["CartPole", "Ant"], &method, Metric::Default), None);
    }
}
