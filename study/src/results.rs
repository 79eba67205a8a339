//! What trainings and tests come to.

use serde::{Deserialize, Serialize};

/// How far a training has come.
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

/// Figures over test episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TestResult {
    /// Of RL², the last one of each trial.
    pub episodes: u64,
    /// The share of the episodes that were successes.
    pub success_percent: f64,
    /// The 95 % Wilson interval of `success_percent`, [low, high], %.
    pub success_percent_95: [f64; 2],
    /// Mean undiscounted return, never normalised.
    pub mean_return: f64,
    /// Mean number of steps.
    pub mean_length: f64,
}

impl std::fmt::Display for TestResult {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { episodes, success_percent, mean_return, mean_length, .. } = self;
        write!(f, "{episodes} episodes, success {success_percent} %, return {mean_return}, length {mean_length}")
    }
}
