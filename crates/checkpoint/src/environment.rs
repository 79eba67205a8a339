//! The part of an environment that a checkpoint stores.

use std::fmt;

use perturb_policy::ActionKind;
use perturb_protocol::disturbance::is_disturbance;
use perturb_protocol::proto;
use serde::{Deserialize, Serialize};

/// The properties of an environment that a policy depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSummary {
    /// Raised by every change of dynamics, reward or observation.
    pub revision: u32,
    /// An episode is truncated after this many steps.
    pub step_limit: u32,
    /// Names of the entries of an observation.
    pub observation: Vec<String>,
    /// The actions.
    pub action: ActionKind,
    /// Names of the parameters.
    pub parameters: Vec<String>,
    /// Names of the quantities that receipts read back; empty in checkpoints of programs that did not keep them.
    #[serde(default)]
    pub applied: Vec<String>,
    /// SHA-256 of the model; empty without one.
    pub model_hash: String,
}

/// The name of the property that is the hash of a model.
const MODEL: &str = "model";

/// Returns how to mend a difference in the property `what`, as the beginning of a sentence's last part; empty unless the files
/// of a task's folder may have changed.
pub fn task_remedy(what: &str) -> &'static str {
    if what == MODEL { "if the task is a folder, serve its original files; otherwise " } else { "" }
}

/// An environment is no longer what a policy was trained in.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the checkpoint was trained in {environment} with {what} {trained}, but the server has {served}: {}test with the version \
     of perturb that trained it, or train again",
    task_remedy(what)
)]
pub struct Changed {
    /// The environment.
    pub environment: String,
    /// The name of the property that differs.
    pub what: &'static str,
    /// In training.
    pub trained: String,
    /// On the server.
    pub served: String,
}

impl EnvironmentSummary {
    /// Returns the summary of an environment; `None` if its action space is not given.
    pub fn from_environment(environment: &proto::Environment) -> Option<Self> {
        let action = match environment.action.as_ref()?.kind.as_ref()? {
            proto::action_space::Kind::Discrete(discrete) => ActionKind::Discrete { n: discrete.names.len() },
            proto::action_space::Kind::Continuous(box_) => ActionKind::Continuous { size: box_.channels.len() },
        };
        let names = |channels: &[proto::Channel]| channels.iter().map(|channel| channel.name.clone()).collect();
        Some(Self {
            revision: environment.revision,
            step_limit: environment.step_limit,
            observation: names(&environment.observation),
            action,
            parameters: environment.parameters.iter().map(|parameter| parameter.name.clone()).collect(),
            applied: environment.applied.iter().map(|quantity| quantity.name.clone()).collect(),
            model_hash: environment.model_hash.clone(),
        })
    }

    /// The parameters that are no disturbances.
    fn own_parameters(&self) -> Vec<&str> {
        self.parameters.iter().map(String::as_str).filter(|name| !is_disturbance(name)).collect()
    }

    /// The first part in which `served` is not what this says, with both values; `None` if they are equal. Disturbances are
    /// not compared: they are no part of the environment, and observations tell whether a policy sees them.
    pub fn difference(&self, served: &Self) -> Option<(&'static str, String, String)> {
        let both = |what, trained: &dyn fmt::Debug, served: &dyn fmt::Debug| {
            Some((what, format!("{trained:?}"), format!("{served:?}")))
        };
        match (self, served) {
            (a, b) if a.revision != b.revision => both("revision", &a.revision, &b.revision),
            (a, b) if a.model_hash != b.model_hash => both(MODEL, &a.model_hash, &b.model_hash),
            (a, b) if a.observation != b.observation => both("observations", &a.observation, &b.observation),
            (a, b) if a.action != b.action => both("actions", &a.action, &b.action),
            (a, b) if a.own_parameters() != b.own_parameters() => {
                both("parameters", &a.own_parameters(), &b.own_parameters())
            }
            (a, b) if a.step_limit != b.step_limit => both("step limit", &a.step_limit, &b.step_limit),
            _ => None,
        }
    }
}
