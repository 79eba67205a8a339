//! The part of a checkpoint that describes the environment of the training.

use std::fmt;

use perturb_policy::ActionKind;
use perturb_protocol::disturbance::is_disturbance;
use perturb_protocol::proto;
use serde::{Deserialize, Serialize};

/// The properties of an environment on which a policy depends.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSummary {
    /// The environment's revision, which every change of dynamics, reward or observation increases.
    pub revision: u32,
    /// The number of steps after which an episode is truncated.
    pub step_limit: u32,
    /// The names of an observation's elements.
    pub observation: Vec<String>,
    /// The kind and the number of actions.
    pub action: ActionKind,
    /// The names of the parameters. If the training used disturbances, they are at the end.
    pub parameters: Vec<String>,
    /// The names of the quantities that the server reads back from the physics. Empty in checkpoints of older programs,
    /// which did not store them.
    #[serde(default)]
    pub applied: Vec<String>,
    /// SHA-256 of the model's MJCF text, or of all files of the task folder that the server read. Empty for an
    /// environment without a model.
    pub model_hash: String,
}

/// The name of the property `model_hash` in error messages.
const MODEL: &str = "model";

/// Returns additional advice for the error message about the property `what`, which differs in a served environment.
/// The advice is empty unless `what` is the model: a different model may mean that the files in a task's folder have
/// changed.
pub fn task_remedy(what: &str) -> &'static str {
    if what == MODEL { "if the task is a folder, serve its original files; otherwise " } else { "" }
}

/// The error if a served environment differs from the one in which a policy was trained.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the checkpoint was trained in {environment} with {what} {trained}, but the server has {served}: {}test with the version \
     of perturb that trained it, or train again",
    task_remedy(what)
)]
pub struct Changed {
    /// The name of the environment.
    pub environment: String,
    /// The name of the property that differs.
    pub what: &'static str,
    /// The property's value in training.
    pub trained: String,
    /// The property's value on the server.
    pub served: String,
}

impl EnvironmentSummary {
    /// Returns the properties of an environment, or `None` if its action space is missing.
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

    /// Returns the names of the parameters that are not disturbances.
    fn own_parameters(&self) -> Vec<&str> {
        self.parameters.iter().map(String::as_str).filter(|name| !is_disturbance(name)).collect()
    }

    /// Returns the first property that differs in `served`, with the values of both. Returns `None` if all are equal.
    /// The names of disturbances among the parameters are not compared. If the policy observes disturbances, they are
    /// found by the comparison of observations.
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
