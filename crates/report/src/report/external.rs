//! Notes of a report about agents that were trained outside of the experiment.

use std::collections::BTreeMap;

use perturb_experiment::{MethodResults, Results, distinct, elsewhere};
use perturb_records::{ExternalEvaluation, ExternalPolicy};

/// Returns the sentences about agents that were trained outside of the experiment: that they exist, how each policy was
/// trained and tested, and whether the revision or the model of its environment differs from others. Returns an empty
/// list if there are no such agents.
pub(super) fn sentences(results: &Results<'_>, selections: &[MethodResults<'_>]) -> Vec<String> {
    let agents = distinct(selections.iter().filter(|row| row.method.external).map(|row| row.method.clone()));
    if agents.is_empty() {
        return Vec::new();
    }
    let count = if agents.len() == 1 { "1 agent was".to_owned() } else { format!("{} agents were", agents.len()) };
    let compared = if results.plan.cells.is_empty() {
        ""
    } else {
        " In the experiment's environments, success is judged by the experiment's rule. No configuration was selected. No \
         run is paired with a run of the experiment, because the seeds of trainings and tests differ."
    };
    let mut lines = vec![format!(
        "{count} trained elsewhere, with unknown settings, and only tested here; their rows say so.{compared}"
    )];
    let mut known: BTreeMap<&str, (u32, &str)> = BTreeMap::new();
    for result in results.done() {
        let training = &result.training;
        known.entry(&training.environment).or_insert((training.environment_revision, &training.model_hash));
    }
    for (agent, policy, run) in elsewhere(selections) {
        lines.push(policy_sentence(agent, policy, run));
        let (name, revision) = (agent.environment(), policy.records.about.revision);
        let Some(episode) = policy.records.episodes.first() else { continue };
        let model = episode.model_hash.as_str();
        let (first, first_model) = *known.entry(name).or_insert((revision, model));
        let others = "the numbers come from different environments.";
        if first != revision {
            lines.push(format!(
                "{} was tested in revision {revision} of {name}, others in revision {first}: {others}",
                agent.agent
            ));
        }
        if first_model != model {
            lines.push(format!(
                "{} was tested with the model {model} of {name}, others with {first_model}: {others}",
                agent.agent
            ));
        }
    }
    distinct(lines.into_iter())
}

/// Returns a sentence on how a policy was trained and tested.
fn policy_sentence(agent: &ExternalEvaluation, policy: &ExternalPolicy, run: u32) -> String {
    let ExternalPolicy { known, records, .. } = policy;
    let saved = if agent.name.is_empty() { "not saved".into() } else { format!("saved as `{}`", agent.name) };
    let steps = known.timesteps.map_or("not known".into(), |steps| steps.to_string());
    let success = records.about.success.as_ref().map_or("not judged".into(), ToString::to_string);
    format!(
        "{} on {}, run {run}: trained on {}, training steps: {steps}, policy `{}`; {} episodes per test with seed {}, \
         success: {success}; {saved}.",
        agent.agent,
        agent.environment(),
        policy.trained_on(),
        records.about.policy,
        known.episodes,
        known.seed,
    )
}

#[cfg(test)]
#[path = "external_tests.rs"]
mod tests;
