//! Externally trained agents in reports.

use std::collections::BTreeMap;

use perturb_experiment::{MethodResults, Results, distinct, elsewhere};
use perturb_records::{ExternalEvaluation, ExternalPolicy};
use perturb_text::Table;

use super::numbers::or_empty;
use super::{MISSING, Report};

/// A policy that no cell trained.
pub(super) struct ExternalRow<'a> {
    agent: &'a ExternalEvaluation,
    policy: &'a ExternalPolicy,
    run: u32,
}

/// In the order of `selections`.
pub(super) fn all<'a>(selections: &[MethodResults<'a>]) -> Vec<ExternalRow<'a>> {
    elsewhere(selections).into_iter().map(|(agent, policy, run)| ExternalRow { agent, policy, run }).collect()
}

/// Returns the notes that precede the agents' numbers.
pub(super) fn overview(results: &Results<'_>, selections: &[MethodResults<'_>]) -> Vec<String> {
    let agents = distinct(selections.iter().filter(|row| row.method.external).map(|row| row.method.clone()));
    if agents.is_empty() {
        return Vec::new();
    }
    let (count, verb) = if agents.len() == 1 {
        ("1 agent was".to_owned(), "its")
    } else {
        (format!("{} agents were", agents.len()), "their")
    };
    let compared = if results.plan.cells.is_empty() {
        ""
    } else {
        " In the experiment's environments success is judged by its rule. No configuration was selected, and no run is \
         paired with the experiment's: seeds of trainings and tests are others."
    };
    let mut lines = vec![format!(
        "{count} trained elsewhere, by settings that are not known here, and only tested; rows say so. The last table has \
         what is known of {verb} policies.{compared}"
    )];
    let mut revisions: BTreeMap<&str, u32> = BTreeMap::new();
    for result in results.done() {
        revisions.entry(&result.training.environment).or_insert(result.training.environment_revision);
    }
    for (agent, policy, _) in elsewhere(selections) {
        let (name, got) = (agent.environment(), policy.records.about.revision);
        let known = *revisions.entry(name).or_insert(got);
        if known != got {
            lines.push(format!(
                "{} was tested in revision {got} of {name}, others in revision {known}: their numbers are of different \
                 environments.",
                agent.agent
            ));
        }
    }
    let mut models: BTreeMap<&str, &str> = BTreeMap::new();
    for result in results.done() {
        models.entry(&result.training.environment).or_insert(&result.training.model_hash);
    }
    for (agent, policy, _) in elsewhere(selections) {
        let Some(episode) = policy.records.episodes.first() else { continue };
        let (name, got) = (agent.environment(), episode.model_hash.as_str());
        let known = *models.entry(name).or_insert(got);
        if known != got {
            lines.push(format!(
                "{} was tested with the model {got} of {name}, others with {known}: their numbers are of different \
                 environments.",
                agent.agent
            ));
        }
    }
    distinct(lines.into_iter())
}

impl ExternalRow<'_> {
    /// Returns the success criterion in words.
    fn success(&self) -> String {
        self.policy.records.about.success.as_ref().map_or_else(|| MISSING.to_owned(), ToString::to_string)
    }
}

impl Report<'_> {
    /// `None` without such agents.
    pub(super) fn elsewhere_table(&self) -> Option<Table> {
        let title = "Trained elsewhere: policies that were only tested (external.csv has the seeds of their tests)";
        let table = Table::builder(title, &self.elsewhere)
            .text("environment", |row| row.agent.environment())
            .text("agent", |row| &row.agent.agent)
            .text("trained on", |row| row.policy.trained_on())
            .text("run", |row| row.run)
            .number("steps of training", |row| {
                row.policy.known.timesteps.map_or("not known".into(), |it| it.to_string())
            })
            .text("policy", |row| &row.policy.records.about.policy)
            .text("success", ExternalRow::success)
            .number("episodes of a test", |row| row.policy.known.episodes)
            .text("assessment", |row| if row.agent.name.is_empty() { "not saved" } else { &row.agent.name })
            .build();
        (!table.rows.is_empty()).then_some(table)
    }

    pub(super) fn elsewhere_file(&self) -> Table {
        Table::builder("external.csv", &self.elsewhere)
            .text("environment", |row| row.agent.environment())
            .text("agent", |row| &row.agent.agent)
            .text("train", |row| row.policy.trained_on())
            .number("run", |row| row.run)
            .number("timesteps", |row| or_empty(row.policy.known.timesteps))
            .text("policy", |row| &row.policy.records.about.policy)
            .text("observe", |row| row.policy.known.observe)
            .text("deterministic", |row| or_empty(row.policy.known.deterministic))
            .text("success", ExternalRow::success)
            .number("revision", |row| row.policy.records.about.revision)
            .number("seed", |row| row.policy.known.seed)
            .number("episodes", |row| row.policy.known.episodes)
            .text("assessment", |row| &row.agent.name)
            .build()
    }
}

#[cfg(test)]
#[path = "external_tests.rs"]
mod tests;
