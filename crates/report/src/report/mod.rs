//! The report of an experiment: its results, compared with the paper's numbers.
//!
//! [`Report::new`] computes the numbers. [`Report::text`], [`Report::markdown`] and [`ReportBundle::page`] render them
//! as documents, and [`Report::files`] as CSV files. The output depends only on the results: not on when, where or in
//! how many attempts the cells were run.

mod columns;
mod comparison;
mod comparisons;
mod csv;
mod curves;
mod external;
mod finding;
mod heatmap_pictures;
mod html;
mod index;
mod numbers;
mod pictures;
mod profiles;
mod provenance;
mod sources;
mod sweeps;
mod tables;
mod title;

use comparisons::MethodComparison;
use index::ReportIndex;
use numbers::MethodMetrics;
use profiles::Profile;
use sweeps::SweepPoint;

pub use comparison::EnvironmentComparison;
pub use curves::curves_table;
pub use heatmap_pictures::{HeatmapPictures, heatmap_pictures, save_heatmaps};
pub use html::comparison_page;
use perturb_experiment::{MethodResults, Plan, Recorded, Reported, Results, Selected, SelectionBootstrap};
use perturb_records::ParameterCheck;
use perturb_text::Table;
pub use pictures::{Picture, PictureDrawing};
pub use sources::{ReportBundle, ReportError, ReportInputs, StudySource};

/// The text for a missing number.
const MISSING: &str = "missing";

/// The report of an experiment.
pub struct Report<'a> {
    plan: &'a Plan,
    scope: ReportIndex<'a>,
    selections: &'a [MethodResults<'a>],
    /// Sentences on the scope and origin of the results. Code words are between backticks.
    provenance: Vec<String>,
    metrics: Vec<MethodMetrics<'a>>,
    averages: Vec<MethodMetrics<'a>>,
    comparisons: Vec<MethodComparison>,
    profiles: Vec<Profile>,
    over_parameters: Vec<SweepPoint<'a>>,
}

impl<'a> Report<'a> {
    /// Computes the report of `results`. `selections` are the selected policies, including agents that were trained
    /// outside of the experiment. `recorded` has the recorded episodes of selected cells. `checks` are the comparisons
    /// of requested and applied parameters in recorded episodes.
    pub fn new(
        results: &'a Results<'a>,
        selections: &'a [MethodResults<'a>],
        recorded: &'a Recorded,
        checks: &[ParameterCheck],
    ) -> Self {
        let scope = ReportIndex::new(results.plan, selections);
        let averages = numbers::averages(&scope, selections, &SelectionBootstrap::new(results));
        Self {
            plan: results.plan,
            selections,
            provenance: provenance::sentences(results, selections, recorded, checks),
            metrics: numbers::metrics(selections),
            comparisons: comparisons::comparisons(&scope, selections),
            profiles: profiles::profiles(&scope, selections, &averages),
            averages,
            over_parameters: sweeps::over_parameters(&scope, selections, recorded),
            scope,
        }
    }

    /// Renders the report as text for a terminal that is `width` characters wide.
    pub fn text(&self, width: usize) -> String {
        let shown = self.tables().map(|table| format!("\n{}\n{}\n", table.title, table.to_text_within(width)));
        format!("{}\n{}", self.sentences().join("\n"), shown.collect::<String>())
    }

    /// Renders the report as Markdown, for example for GitHub.
    pub fn markdown(&self) -> String {
        let shown = self.tables().map(|table| format!("\n## {}\n\n{}\n", table.title, table.to_markdown()));
        format!("# Results\n\n{}\n{}", self.sentences().join("\n\n"), shown.collect::<String>())
    }

    /// Returns the pictures of the report: the main result, each environment, performance profiles, and success over
    /// parameters. Pictures without numbers are left out.
    pub fn pictures(&self) -> Vec<Picture> {
        let finding = self.finding_pictures().into_iter().chain(self.environment_pictures());
        finding.chain(self.profiles_picture()).chain(self.parameter_pictures()).collect()
    }

    /// Returns the sentences of the main result, followed by the scope and origin of the results.
    fn sentences(&self) -> Vec<String> {
        self.finding_sentences().into_iter().chain(self.provenance.iter().cloned()).collect()
    }

    /// Returns the tables that the report shows as text.
    fn tables(&self) -> impl Iterator<Item = Table> {
        let numbers = self.metrics_tables().into_iter().chain(self.scenario_tables());
        numbers.chain(self.iqm_table()).chain(self.comparisons_table())
    }

    /// Returns all selected cells, whose tests the report shows.
    fn selected(&self) -> Vec<Selected<'a>> {
        let runs = self.selections.iter().flat_map(|selection| selection.runs.values());
        runs.flat_map(|run| run.selected.values().flatten()).filter_map(Reported::cell).collect()
    }
}

#[cfg(test)]
mod recorded_tests;
#[cfg(test)]
mod tests;
