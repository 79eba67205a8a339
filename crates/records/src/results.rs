//! Results of tests.

use serde::{Deserialize, Serialize};

/// Statistics over the episodes of a test.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TestResult {
    /// The number of episodes. With RL², only the last episode of each trial counts.
    pub episodes: u64,
    /// Success rate, in %.
    pub success_percent: f64,
    /// The 95 % Wilson interval of the success rate, [low, high] in %.
    pub success_percent_95: [f64; 2],
    /// Mean undiscounted return of the original (not normalised) rewards.
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
