//! RL²: learning to learn within a trial.

use serde::{Deserialize, Serialize};

use super::check_episodes;
use crate::error::Result;

/// Settings of RL², Duan et al. (2016), arXiv:1611.02779, beside those of A2C or PPO, which it is wrapped around.
///
/// A trial is N episodes in one drawn environment. The policy is recurrent, keeps its memory from one episode of a trial
/// to the next, and gets beside the observation what it did and what came of it
/// ([`Inputs`](crate::policy::Inputs)); returns and advantages run across the episodes of a trial. So the policy that
/// does best is one that uses a trial's first steps to find out which environment it is in. The update is that of A2C or
/// PPO as it is, with [`kl_coef`](super::PpoConfig::kl_coef) for RL²-PPO: collecting alone differs
/// ([`Collector`](crate::rollout::Collector)).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rl2Config {
    /// N: episodes in a trial, 1 … 10⁶ (default: `2`; the paper also tries 1 and 5). Testing counts a trial's last.
    pub episodes_per_trial: u32,
}

impl Default for Rl2Config {
    fn default() -> Self {
        Rl2Config { episodes_per_trial: 2 }
    }
}

impl Rl2Config {
    /// Refuses values outside their ranges.
    pub fn validate(&self) -> Result<()> {
        check_episodes("episodes_per_trial", self.episodes_per_trial as usize)
    }
}
