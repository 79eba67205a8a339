//! Counters of a training's progress.

use serde::{Deserialize, Serialize};

/// Counters of a training's progress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counters {
    /// Number of iterations; each consists of a rollout and an update.
    pub iterations: u64,
    /// Number of steps, summed over all environments. EPOpt counts only the steps of complete episodes.
    pub timesteps: u64,
    /// Number of episodes that count towards the training's budget. These are all ended episodes or, with EPOpt, only
    /// the episodes from which the policy learned.
    pub episodes: u64,
    /// Number of episodes that ended. EPOpt plays more episodes than it learns from.
    #[serde(default)]
    pub generated_episodes: u64,
    /// Number of steps from which the policy learned.
    #[serde(default)]
    pub learned_timesteps: u64,
}
