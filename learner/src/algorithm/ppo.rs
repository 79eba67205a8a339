//! Proximal policy optimisation.

use serde::{Deserialize, Serialize};

use super::{Algorithm, AlgorithmState, Schedule, UpdateStats};
use crate::error::{Result, check};
use crate::policy::Policy;
use crate::rollout::Rollout;

/// Settings of [`Ppo`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PpoConfig {
    /// Step size of Adam; default 3e-4.
    pub learning_rate: f64,
    /// How the learning rate moves; default constant.
    pub learning_rate_schedule: Schedule,
    /// T: steps of each environment between two updates; default 128.
    pub n_steps: usize,
    /// Passes over a rollout; default 10.
    pub n_epochs: usize,
    /// Minibatches in a pass; default 1.
    pub n_minibatches: usize,
    /// Discount factor per step; default 0.99.
    pub gamma: f64,
    /// λ of generalised advantage estimation; default 0.95.
    pub gae_lambda: f64,
    /// Half-width of the ratio's clipping interval; default 0.2.
    pub clip_range: f64,
    /// The same for values, None = not clipped; default 0.2.
    pub clip_range_vf: Option<f64>,
    /// Whether advantages are normalised within a minibatch; default true.
    pub normalize_advantage: bool,
    /// Weight of the entropy; default 0.
    pub ent_coef: f64,
    /// Weight of the value loss; default 0.5.
    pub vf_coef: f64,
    /// Global norm that gradients are clipped to; default 0.5.
    pub max_grad_norm: f64,
    /// Adam's ε; default 1e-5.
    pub adam_eps: f64,
    /// Whether V(final observation) follows the last reward of a truncated episode; default true.
    pub bootstrap_truncation: bool,
}

impl Default for PpoConfig {
    fn default() -> Self {
        PpoConfig {
            learning_rate: 3e-4,
            learning_rate_schedule: Schedule::Constant,
            n_steps: 128,
            n_epochs: 10,
            n_minibatches: 1,
            gamma: 0.99,
            gae_lambda: 0.95,
            clip_range: 0.2,
            clip_range_vf: Some(0.2),
            normalize_advantage: true,
            ent_coef: 0.0,
            vf_coef: 0.5,
            max_grad_norm: 0.5,
            adam_eps: 1e-5,
            bootstrap_truncation: true,
        }
    }
}

impl PpoConfig {
    /// Refuses values outside their ranges.
    pub fn validate(&self) -> Result<()> {
        check("learning_rate", self.learning_rate, self.learning_rate > 0.0, "a positive number")
    }
}

/// Proximal policy optimisation.
pub struct Ppo {}

impl Ppo {
    /// Starts with fresh optimiser state for `policy`; `seed` fixes the order of minibatches.
    pub fn new(_config: PpoConfig, _policy: &Policy, _seed: u64) -> Result<Self> {
        todo!()
    }
}

impl Algorithm for Ppo {
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
