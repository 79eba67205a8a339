//! The environments, methods and test sets that a report shows, from its plan and from agents that were trained outside
//! of the experiment.

use std::collections::BTreeSet;

use perturb_experiment::{MethodResults, Plan, distinct, elsewhere};
use perturb_protocol::Version;
use perturb_records::TrainedOn;
use perturb_settings::Method;

/// The environments, methods and test sets of a report, in the order in which they are shown.
#[derive(Clone, Debug)]
pub(super) struct ReportIndex<'a> {
    /// The environments over which results are averaged: the plan's environments, or all environments without a plan.
    pub(super) averaged: Vec<&'a str>,
    /// All environments in the report.
    pub(super) environments: Vec<&'a str>,
    /// All methods in the report.
    pub(super) methods: Vec<Method>,
    /// The names of the test sets.
    pub(super) tested_on: Vec<&'a str>,
}

impl<'a> ReportIndex<'a> {
    /// Collects the names from the plan and the selections.
    pub(super) fn new(plan: &'a Plan, selections: &[MethodResults<'a>]) -> Self {
        let environments = distinct(selections.iter().map(|row| row.environment));
        let averaged = if plan.cells.is_empty() { environments.clone() } else { plan.environments() };
        let of_plan = plan.cells.iter().take(1).flat_map(|cell| &cell.tests.sets);
        let assessed = elsewhere(selections);
        let of_others = assessed.iter().flat_map(|(_, policy, _)| &policy.records.about.tests).map(|test| &test.set);
        let mut tested_on = distinct(of_plan.chain(of_others).map(|set| set.name.as_str()));
        // Sets that are not versions come after the versions. Without a plan they come first.
        let own_set = if plan.cells.is_empty() { -1 } else { Version::KNOWN.len() as i32 };
        tested_on.sort_by_key(|name| version(name).map_or(own_set, |version| version as i32));
        Self { averaged, environments, methods: distinct(selections.iter().map(|row| row.method.clone())), tested_on }
    }
}

/// Returns the version with this name; `None` if there is none.
pub(super) fn version(name: &str) -> Option<Version> {
    Version::KNOWN.into_iter().find(|version| version.to_string() == name)
}

/// Returns whether a row is shown in the tables of scenarios. A row of an agent that was trained outside of the
/// experiment is shown only if a policy was trained on a version.
pub(super) fn has_scenarios(row: &MethodResults<'_>) -> bool {
    !row.method.external || trained_on(row).iter().any(|one| matches!(one, TrainedOn::Version(_)))
}

/// Returns the training distributions of all policies in a row: the union over its runs. The runs of an agent that was
/// trained outside of the experiment may have different training distributions.
pub(super) fn trained_on<'a>(row: &MethodResults<'a>) -> BTreeSet<TrainedOn<'a>> {
    row.runs.values().flat_map(|run| run.selected.keys().copied()).collect()
}
