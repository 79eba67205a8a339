//! Agents that were not trained by a cell of the experiment. They are additional rows of its report.

use std::collections::BTreeMap;

use perturb_records::success::Rule;
use perturb_records::{ExternalEvaluation, ExternalPolicy};
use perturb_settings::ValueError;

use crate::plan::Plan;
use crate::selection::{MethodResults, Reported, SelectedRun};

/// Returns the assessment with its success judged by the rule that the plan's cells have in this environment. Without such
/// cells it is unchanged.
///
/// # Errors
/// [`ValueError`] if the episodes cannot be judged by it.
pub fn judged_as_in(plan: &Plan, assessed: ExternalEvaluation) -> Result<ExternalEvaluation, ValueError> {
    let in_environment = |cell: &&crate::plan::Cell| cell.config.common.environment == assessed.environment();
    let Some(cell) = plan.cells.iter().find(in_environment) else { return Ok(assessed) };
    assessed.judged_by(&cell.tests.success.clone().unwrap_or(Rule::Text))
}

/// Adds the agents of `assessed` to the rows of a report, after the other rows of their environment. Assessments of the same
/// agent become its runs. Assessments share a run if they have no training distribution in common. An assessment is never
/// split over two runs.
pub fn add_assessed<'a>(selections: &mut Vec<MethodResults<'a>>, assessed: &'a [ExternalEvaluation]) {
    for one in assessed {
        let (environment, method) = (one.environment(), one.method());
        let known = selections.iter().position(|row| row.environment == environment && row.method == method);
        let place = known.unwrap_or_else(|| {
            let last = selections.iter().rposition(|row| row.environment == environment);
            let place = last.map_or(selections.len(), |last| last + 1);
            selections.insert(place, MethodResults { environment, method, cells: 0, done: 0, runs: BTreeMap::new() });
            place
        });
        let runs = &mut selections[place].runs;
        let has = |run: &SelectedRun<'_>, policy: &ExternalPolicy| run.selected.contains_key(&policy.trained_on());
        let is_free = |run: &SelectedRun<'_>| !one.policies().iter().any(|policy| has(run, policy));
        let run = (1..).find(|run: &u32| runs.get(run).is_none_or(is_free)).unwrap_or_default();
        let reported = |policy: &'a ExternalPolicy| (policy.trained_on(), Some(Reported::External(one, policy)));
        runs.entry(run).or_default().selected.extend(one.policies().iter().map(reported));
    }
}

/// Returns the externally trained agents of `selections`, with their policies and run numbers, in order.
pub fn elsewhere<'a>(selections: &[MethodResults<'a>]) -> Vec<(&'a ExternalEvaluation, &'a ExternalPolicy, u32)> {
    let runs = selections.iter().flat_map(|row| &row.runs);
    let policies = runs.flat_map(|(run, of)| of.selected.values().flatten().map(|reported| (*run, reported)));
    let elsewhere = policies.filter_map(|(run, reported)| match reported {
        Reported::External(agent, policy) => Some((*agent, *policy, run)),
        Reported::Cell(_) => None,
    });
    elsewhere.collect()
}

#[cfg(test)]
#[path = "external_tests.rs"]
mod tests;
