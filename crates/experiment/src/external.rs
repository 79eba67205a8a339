//! Agents that no cell of an experiment trained, as rows of a report beside the experiment's own.

use std::collections::BTreeMap;

use perturb_records::success::Rule;
use perturb_records::{ExternalEvaluation, ExternalPolicy};
use perturb_settings::ValueError;

use crate::plan::Plan;
use crate::selection::{MethodResults, Reported, SelectedRun};

/// An assessment with success judged by the rule of the plan's cells in its environment, where the plan has some.
///
/// # Errors
/// [`ValueError`] if the episodes cannot be judged by it.
pub fn judged_as_in(plan: &Plan, assessed: ExternalEvaluation) -> Result<ExternalEvaluation, ValueError> {
    let in_environment = |cell: &&crate::plan::Cell| cell.config.common.environment == assessed.environment();
    let Some(cell) = plan.cells.iter().find(in_environment) else { return Ok(assessed) };
    assessed.judged_by(&cell.tests.success.clone().unwrap_or(Rule::Text))
}

/// Adds the agents of `assessed` to the rows of a report: behind the others of their environment. Assessments of one agent
/// are runs of it; of those that have nothing in common of what they were trained on one run is made. An assessment is
/// never of two runs.
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

/// The agents of `selections` that something else trained, with their policies and the numbers of their runs, in order.
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
