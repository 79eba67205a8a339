//! Agents that were trained elsewhere, not by a cell of the experiment. They are additional rows of its report.

use std::collections::BTreeMap;

use perturb_records::success::Rule;
use perturb_records::{ExternalEvaluation, ExternalPolicy};
use perturb_settings::ValueError;

use crate::plan::Plan;
use crate::selection::{MethodResults, Reported, SelectedRun};

/// Judges the success of the assessed episodes again, by the success rule of the plan's first cell in the same
/// environment. Returns the assessment unchanged if the plan has no cell in this environment.
///
/// # Errors
/// [`ValueError`] if the quantity that the rule compares was not recorded.
pub fn judged_as_in(plan: &Plan, assessed: ExternalEvaluation) -> Result<ExternalEvaluation, ValueError> {
    let in_environment = |cell: &&crate::plan::Cell| cell.config.common.environment == assessed.environment();
    let Some(cell) = plan.cells.iter().find(in_environment) else { return Ok(assessed) };
    assessed.judged_by(&cell.tests.success.clone().unwrap_or(Rule::Text))
}

/// Adds the agents of `assessed` to the rows of a report, after the other rows of their environment.
///
/// Assessments of the same agent become numbered runs of this agent. Two assessments are put into the same run only if
/// no training distribution occurs in both. All policies of one assessment are in one run.
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

/// Returns the policies in `selections` that were trained elsewhere, in order: each with its assessment and its run
/// number.
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
