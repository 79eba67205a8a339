//! Algorithms: what turns a rollout into better weights.

mod a2c;
mod ppo;

pub use a2c::{A2c, A2cConfig};
pub use ppo::{Ppo, PpoConfig};

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::policy::{NamedArray, Policy};
use crate::rollout::Rollout;

/// Learns from rollouts.
pub trait Algorithm {
    /// T: steps of each environment between two updates.
    fn n_steps(&self) -> usize;

    /// Improves `policy` by a full, finished rollout. `progress_remaining` falls from 1 at the start of training to 0
    /// at its end.
    fn update(&mut self, policy: &mut Policy, rollout: &Rollout, progress_remaining: f64) -> Result<UpdateStats>;

    /// Everything beside the policy's weights that a later update depends on.
    fn state(&self) -> AlgorithmState;

    /// Goes on from a saved state: later updates give the same bytes as if there had been no break.
    fn load_state(&mut self, state: &AlgorithmState) -> Result<()>;
}

/// The state of an algorithm, for exact resumption.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlgorithmState {
    /// Gradient steps so far.
    pub n_updates: u64,
    /// The optimiser's running averages.
    pub optimiser: Vec<NamedArray>,
    /// The stream of minibatch orders, where there is one.
    pub rng: Option<ChaCha8Rng>,
}

/// How a learning rate moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// Stays.
    Constant,
    /// Falls linearly to 0 at the end of training.
    Linear,
}

/// What happened in an update, by stable-baselines3's names. Averages are over the update's gradient steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct UpdateStats {
    /// The optimiser's step size.
    pub learning_rate: f64,
    /// The policy's part of the loss.
    pub policy_gradient_loss: f64,
    /// The value network's part of the loss, before `vf_coef`.
    pub value_loss: f64,
    /// Minus the mean entropy, before `ent_coef`, in nats.
    pub entropy_loss: f64,
    /// The sum that was minimised.
    pub loss: f64,
    /// Estimate of the KL divergence of the new from the acting policy, in nats; PPO only.
    pub approx_kl: Option<f64>,
    /// Share of samples whose ratio was outside `1 ± clip_range`; PPO only.
    pub clip_fraction: Option<f64>,
    /// `clip_range`; PPO only.
    pub clip_range: Option<f64>,
    /// Share of the variance of the returns that the rollout's values explain; None if the returns are constant.
    pub explained_variance: Option<f64>,
    /// Global norm of the gradient, before clipping.
    pub grad_norm: f64,
    /// Gradient steps so far, this update's included.
    pub n_updates: u64,
    /// Mean standard deviation of the actions; continuous actions only.
    pub std: Option<f64>,
}
