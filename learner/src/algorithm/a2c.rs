//! Advantage actor-critic.

use serde::{Deserialize, Serialize};

use super::{Algorithm, AlgorithmState, Schedule, UpdateStats};
use crate::error::{Result, check};
use crate::policy::Policy;
use crate::rollout::Rollout;

/// Settings of [`A2c`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct A2cConfig {
    /// Step size of RMSProp; default 7e-4.
    pub learning_rate: f64,
    /// How the learning rate moves; default linear to 0.
    pub learning_rate_schedule: Schedule,
    /// T: steps of each environment between two updates; default 5.
    pub n_steps: usize,
    /// Discount factor per step; default 0.99.
    pub gamma: f64,
    /// Weight of the entropy; default 0.01.
    pub ent_coef: f64,
    /// Weight of the value loss; default 0.5.
    pub vf_coef: f64,
    /// Global norm that gradients are clipped to; default 0.5.
    pub max_grad_norm: f64,
    /// Decay of RMSProp's average of squared gradients; default 0.99.
    pub rms_alpha: f64,
    /// RMSProp's ε; default 1e-5.
    pub rms_eps: f64,
    /// Whether V(final observation) follows the last reward of a truncated episode; default true.
    pub bootstrap_truncation: bool,
}

impl Default for A2cConfig {
    fn default() -> Self {
        A2cConfig {
            learning_rate: 7e-4,
            learning_rate_schedule: Schedule::Linear,
            n_steps: 5,
            gamma: 0.99,
            ent_coef: 0.01,
            vf_coef: 0.5,
            max_grad_norm: 0.5,
            rms_alpha: 0.99,
            rms_eps: 1e-5,
            bootstrap_truncation: true,
        }
    }
}

impl A2cConfig {
    /// Refuses values outside their ranges.
    pub fn validate(&self) -> Result<()> {
        check("learning_rate", self.learning_rate, self.learning_rate > 0.0, "a positive number")
    }
}

/// Advantage actor-critic.
pub struct A2c {}

impl A2c {
    /// Starts with fresh optimiser state for `policy`.
    pub fn new(_config: A2cConfig, _policy: &Policy) -> Result<Self> {
        todo!()
    }
}

impl Algorithm for A2c {
    fn n_steps(&self) -> usize {
        todo!()
    }
    fn update(&mut self, _policy: &mut Policy, _rollout: &Rollout, _progress_remaining: f64) -> Result<UpdateStats> {
        todo!()
    }
    fn state(&self) -> AlgorithmState {
        todo!()
    }
    fn load_state(&mut self, _state: &AlgorithmState) -> Result<()> {
        todo!()
    }
}
