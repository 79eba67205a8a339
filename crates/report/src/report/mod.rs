//! An experiment's results beside the paper's.
//!
//! [`Report::new`] has the numbers; [`Report::text`], [`Report::markdown`] and [`html`] make documents of them,
//! [`Report::files`] CSV. Nothing in them depends on when, where or in how many attempts the cells were done.

mod columns;
mod comparisons;
mod csv;
mod curves;
mod external;
mod figure;
mod figures;
mod finding;
mod heatmap_pictures;
mod html;
mod index;
mod links;
mod metadata;
mod numbers;
mod paired_difference;
mod pictures;
mod profiles;
mod sample_efficiency;
mod settings;
mod sources;
mod sweep_pictures;
mod sweeps;
mod tables;
mod tail_risk;
mod tested;

use std::collections::BTreeSet;

use crate::generalization_curves::{GeneralizationPoint, generalization_curves};
use comparisons::MethodComparison;
use external::ExternalRow;
use index::ReportIndex;
use numbers::{MethodMetrics, SetTest};
use paired_difference::PairedDifference;
use profiles::Profile;
use sample_efficiency::SampleEfficiency;
use settings::{GridTests, grid_tests};
use sweeps::{AtParameter, AtThreshold, SweepPoint};
use tail_risk::TailRisk;

pub use csv::old_file_name;
pub use curves::curves_table;
pub use figure::{Figure, FigureData};
pub use figures::Figures;
pub use heatmap_pictures::{HeatmapPicture, heatmap_pictures, save_heatmaps};
pub use html::html;
use perturb_experiment::{
    Cell, EnvironmentCurves, Failure, MethodResults, Plan, Recorded, Reported, Results, Selected, Selection,
    SelectionBootstrap, Tuned, elsewhere as elsewhere_in,
};
use perturb_text::{Table, count};
pub use pictures::{Picture, PictureDrawing};
pub use sources::{ReportBundle, ReportError, ReportInputs, StudySource};

/// The paper's budgets.
const PAPER_EPISODES: u64 = 15_000;
const PAPER_TEST_EPISODES: u64 = 1000;
/// The text for a missing number.
const MISSING: &str = "missing";

/// The report of an experiment.
pub struct Report<'a> {
    plan: &'a Plan,
    scope: ReportIndex<'a>,
    selections: &'a [MethodResults<'a>],
    /// Sentences, with `names` between backticks.
    overview: Vec<String>,
    metrics: Vec<MethodMetrics<'a>>,
    averages: Vec<MethodMetrics<'a>>,
    comparisons: Vec<MethodComparison>,
    gains: Vec<PairedDifference<'a>>,
    profiles: Vec<Profile>,
    worst: Vec<TailRisk<'a>>,
    over_parameters: Vec<SweepPoint<'a, AtParameter<'a>>>,
    over_thresholds: Vec<SweepPoint<'a, AtThreshold<'a>>>,
    set_tests: Vec<SetTest<'a>>,
    trainings: Vec<SampleEfficiency<'a>>,
    /// Tests of intermediate and final policies; empty without `evaluate_at`.
    marks: Vec<GeneralizationPoint<'a>>,
    /// Tests of every point of a grid.
    grid_tests: GridTests<'a>,
    /// By the clean rule, what was selected; otherwise nothing.
    tuned: Vec<Tuned<'a>>,
    failures: Vec<&'a Failure>,
    elsewhere: Vec<ExternalRow<'a>>,
}

impl<'a> Report<'a> {
    /// Returns the report of `results`. `selections` were made from them, and `recorded` and `curves` are their
    /// recorded episodes and training curves.
    pub fn new(
        results: &'a Results<'a>,
        selections: &'a [MethodResults<'a>],
        recorded: &'a Recorded,
        curves: &[EnvironmentCurves],
    ) -> Self {
        let plan = results.plan;
        let tuned = if plan.selection == Selection::Clean { results.tuned() } else { Vec::new() };
        let scope = ReportIndex::new(plan, selections);
        let averages = numbers::averages(&scope, selections, &SelectionBootstrap::new(results));
        Self {
            plan,
            selections,
            overview: overview(results, selections, recorded, &tuned),
            metrics: numbers::metrics(selections),
            comparisons: comparisons::comparisons(&scope, selections),
            gains: paired_difference::gains(&scope, selections),
            profiles: profiles::profiles(&scope, selections, &averages),
            averages,
            worst: tail_risk::worst(&scope, selections, recorded),
            over_parameters: sweeps::over_parameters(&scope, selections, recorded),
            over_thresholds: sweeps::over_thresholds(&scope, selections, recorded),
            trainings: sample_efficiency::trainings(selections, curves),
            set_tests: numbers::set_tests(&scope, selections),
            marks: generalization_curves(selections),
            grid_tests: grid_tests(results),
            tuned,
            failures: results.failures().collect(),
            elsewhere: external::all(selections),
            scope,
        }
    }

    /// Renders the tables for a terminal of `width` columns, without details. `report.md` has the details.
    pub fn text(&self, width: usize) -> String {
        let tables = self.number_tables().chain(self.failure_table()).chain(self.elsewhere_table());
        let shown = tables.map(|table| format!("\n{}\n{}\n", table.title, table.to_text_within(width)));
        format!("{}\n{}", self.opening().join("\n"), shown.collect::<String>())
    }

    /// For GitHub and the like.
    pub fn markdown(&self) -> String {
        let compared = self.comparisons_table().into_iter().chain(self.gains_table());
        let details = compared.chain(self.worst_tables()).chain(self.footing_tables());
        let cells = self.settings_table().into_iter().chain(self.tuned_table()).chain(self.selected_table());
        let others = self.failure_table().into_iter().chain(self.elsewhere_table());
        let tables = self.number_tables().chain(details).chain(cells).chain(others);
        let shown = tables.map(|table| format!("\n## {}\n\n{}\n", table.title, table.to_markdown()));
        format!("# Results\n\n{}\n{}", self.opening().join("\n\n"), shown.collect::<String>())
    }

    /// Returns the sentences with the main result and its scope.
    fn opening(&self) -> Vec<String> {
        self.finding_sentences().into_iter().chain(self.overview.iter().cloned()).collect()
    }

    fn number_tables(&self) -> impl Iterator<Item = Table> {
        let papers =
            self.metrics_tables().into_iter().chain(self.ties_table()).chain(self.iqm_table()).chain(self.gap_table());
        let scenarios = self.extrapolation_tables().into_iter().chain(self.scenario_tables());
        papers.chain(scenarios).chain(self.set_table()).chain(self.marks_table())
    }

    /// All cells that numbers come from.
    fn selected(&self) -> Vec<Selected<'a>> {
        let runs = self.selections.iter().flat_map(|selection| selection.runs.values());
        runs.flat_map(|run| run.selected.values().flatten()).filter_map(Reported::cell).collect()
    }
}

fn overview(
    results: &Results<'_>,
    selections: &[MethodResults<'_>],
    recorded: &Recorded,
    tuned: &[Tuned<'_>],
) -> Vec<String> {
    let (cells, done, failed) = (results.plan.cells.len(), results.done().count(), results.failures().count());
    let mut lines = Vec::new();
    if cells > 0 {
        lines
            .push(format!("{done} of {cells} cells are done, {failed} failed, {} are missing.", cells - done - failed));
        lines.push(rule(results.plan));
        lines.extend(selected(tuned));
        lines.extend(budgets(results.plan));
    }
    lines.extend(external::overview(results, selections));
    let incomplete = selections.iter().filter(|selection| selection.done < selection.cells).count();
    if incomplete > 0 {
        let rows = selections.iter().filter(|row| !row.method.external).count();
        let (lack, their) = if incomplete == 1 { ("lacks", "its") } else { ("lack", "their") };
        let selected = match results.plan.selection {
            Selection::Paper if results.plan.selects() => {
                format!(", so that {their} configurations were selected among fewer than the plan has")
            }
            Selection::Paper | Selection::Clean => String::new(),
        };
        lines.push(format!(
            "{incomplete} of {} {lack} cells{selected}; the column `cells` says which.",
            count(rows, "row")
        ));
    }
    let commits: BTreeSet<&str> = results.done().flat_map(|result| result.commits()).collect();
    if !commits.is_empty() {
        lines.push(format!("Done by perturb {}.", commits.into_iter().collect::<Vec<_>>().join(", ")));
    }
    lines.extend(agreement(results, selections));
    let (known, selected) = recorded.count();
    if known < selected {
        lines.push(format!(
            "{known} of {selected} selected cells have recorded episodes, from which the worst tenth, and success over \
             parameters and over the threshold, follow."
        ));
    }
    lines.push(
        "Numbers are success rates in percent: mean ± standard deviation over runs; one run has none. The paper's are \
         those of its five runs; a difference is ours less the paper's. Hopper and HalfCheetah run on another physics \
         engine than the paper's, and have none."
            .into(),
    );
    lines
}

/// By which rule configurations are selected, and on which seeds.
fn rule(plan: &Plan) -> String {
    let tuning = seeds(plan.cells.iter().filter(|cell| cell.tuned_as.is_none()));
    match plan.selection {
        Selection::Paper if !plan.selects() => {
            format!("Nothing is selected: each method has one configuration in each environment; {tuning}.")
        }
        Selection::Paper => format!(
            "Selection: `paper`, as published. In each run, the test that selects a configuration is the test that is \
             reported; {tuning}."
        ),
        Selection::Clean => format!(
            "Selection: `clean`. Configurations were selected by {} selection episodes of every training on {tuning}; \
             those that are reported were trained anew on {}, and tested on other episodes.",
            plan.cells.iter().find_map(|cell| cell.tests.selection).unwrap_or_default(),
            seeds(plan.candidates.iter())
        ),
    }
}

fn seeds<'a>(cells: impl Iterator<Item = &'a Cell>) -> String {
    let seeds: BTreeSet<u64> = cells.map(|cell| cell.config.common.seed).collect();
    match (seeds.first(), seeds.last()) {
        (Some(first), Some(last)) if first < last => format!("seeds {first} to {last}"),
        (first, _) => format!("seed {}", first.copied().unwrap_or_default()),
    }
}

/// The number that all cells have, or the least and the most.
fn range(cells: &[Cell], of: fn(&Cell) -> u64) -> String {
    let numbers: BTreeSet<u64> = cells.iter().map(of).collect();
    match (numbers.first(), numbers.last()) {
        (Some(least), Some(most)) if least < most => format!("{least} to {most}"),
        (least, _) => least.map(u64::to_string).unwrap_or_default(),
    }
}

/// Returns notes about the selected configurations.
fn selected(tuned: &[Tuned<'_>]) -> Vec<String> {
    let all = tuned.len();
    let name = |tuned: &Tuned<'_>| format!("{} {} on {}", tuned.environment, tuned.method, tuned.trained_on);
    let names = |of: &dyn Fn(&&Tuned<'_>) -> bool| tuned.iter().filter(of).map(name).collect::<Vec<_>>();
    let waiting = names(&|tuned| !tuned.is_complete());
    let none = names(&|tuned| tuned.is_complete() && tuned.chosen.is_none());
    let partly = tuned.iter().filter_map(|tuned| {
        let chosen = tuned.chosen.filter(|chosen| chosen.seeds < tuned.seeds)?;
        Some(format!("{} ({} of {} tuning seeds)", name(tuned), chosen.seeds, tuned.seeds))
    });
    let partly: Vec<String> = partly.collect();
    let told = [
        ("wait for tuning cells", waiting),
        ("have nothing to select, since all their tuning cells failed", none),
        ("are of configurations some of whose tuning cells failed", partly),
    ];
    let told = told.into_iter().filter(|(_, names)| !names.is_empty());
    told.map(|(what, names)| format!("{} of {all} selections {what}: {}.", names.len(), names.join(", "))).collect()
}

/// Describes the check of requested and applied parameters in all tests.
fn agreement(results: &Results<'_>, selections: &[MethodResults<'_>]) -> Option<String> {
    let of_cells: u64 = results.done().flat_map(|result| result.results.values()).map(|test| test.episodes).sum();
    let others: Vec<_> = elsewhere_in(selections).into_iter().map(|(_, policy, _)| &policy.records).collect();
    let of_others: Vec<_> = others.iter().map(|records| records.agreement()).collect();
    let tested = of_cells + others.iter().map(|records| records.episodes.len() as u64).sum::<u64>();
    let agreements = || results.done().filter_map(|result| result.agreement.as_ref()).chain(&of_others);
    let compared: u64 = agreements().map(|agreement| agreement.episodes).sum();
    let differences = agreements().filter_map(|agreement| agreement.largest.as_ref());
    let largest = differences.max_by(|a, b| a.relative.total_cmp(&b.relative)).map(|largest| match largest.relative {
        0.0 => "; they were equal".to_owned(),
        relative => format!("; the largest relative difference is {relative:.1e}, of {}", largest.parameter),
    });
    // A table of results does not say it.
    (compared > 0).then(|| {
        let largest = largest.unwrap_or_default();
        format!("Requested and applied parameters were compared in {compared} of {tested} test episodes{largest}.")
    })
}

/// Budgets that are not the paper's.
fn budgets(plan: &Plan) -> Option<String> {
    let trained = range(&plan.cells, |cell| cell.config.common.episodes);
    let tested = range(&plan.cells, |cell| cell.tests.episodes);
    if trained == PAPER_EPISODES.to_string() && tested == PAPER_TEST_EPISODES.to_string() {
        return None;
    }
    Some(format!(
        "Other budgets than the paper's: {} episodes in a training, where the paper has {PAPER_EPISODES}, and {} in a \
         test, where it has {PAPER_TEST_EPISODES}.",
        trained, tested
    ))
}

#[cfg(test)]
mod recorded_tests;
#[cfg(test)]
mod tests;
