//! Counters of a training's progress.

use serde::{Deserialize, Serialize};

/// Counters of a training's progress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counters {
    /// Rollouts and updates.
    pub iterations: u64,
    /// Steps of all environments together; EPOpt's are those of complete episodes.
    pub timesteps: u64,
    /// Episodes that the budget counts: those that ended or, with EPOpt, those that it learned from.
    pub episodes: u64,
    /// Episodes that ended; EPOpt generates more than it learns from.
    #[serde(default)]
    pub generated_episodes: u64,
    /// Steps that were learned from.
    #[serde(default)]
    pub learned_timesteps: u64,
}
