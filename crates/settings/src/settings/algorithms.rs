//! The settings of each algorithm.

use serde::{Deserialize, Serialize};

use super::{SettingError, is_zero};

/// The schedule of a learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// Stays.
    Constant,
    /// Falls linearly to 0 at the end of training.
    Linear,
}

impl Schedule {
    /// The learning rate when `progress_remaining`, 1 … 0, of the training is left.
    ///
    /// # Errors
    /// A `progress_remaining` outside 1 … 0.
    pub fn at(self, learning_rate: f64, progress_remaining: f64) -> Result<f64, SettingError> {
        let in_range = (0.0..=1.0).contains(&progress_remaining);
        check("progress_remaining", progress_remaining, in_range, "between 0 and 1")?;
        Ok(match self {
            Schedule::Constant => learning_rate,
            Schedule::Linear => learning_rate * progress_remaining,
        })
    }
}

/// Settings of A2C. The defaults are those of OpenAI Baselines; the paper searches `learning_rate`, `n_steps` and
/// `ent_coef`, for which `perturb train` has defaults of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct A2cConfig {
    /// Step size of RMSProp, above 0 (default: `7e-4`). Larger learns faster, until the policy collapses.
    pub learning_rate: f64,
    /// The schedule of the learning rate: "linear" to 0 over the training, or "constant" (default: `"linear"`).
    pub learning_rate_schedule: Schedule,
    /// T: steps of each environment between two updates, at least 1 (default: `5`). More makes returns less biased, their
    /// variance larger and updates rarer.
    pub n_steps: usize,
    /// Discount factor per step, 0 … 1 (default: `0.99`). Rewards 1/(1-γ) steps ahead count for about a third.
    pub gamma: f64,
    /// Weight of the entropy in nats, not negative (default: `0.01`). Larger keeps actions random for longer.
    pub ent_coef: f64,
    /// Weight of the value loss, which is the mean squared error; not negative (default: `0.5`; paper: `0.25`, because
    /// the authors' code gives half of the squared error the weight 0.5). Feed-forward policy and value networks share
    /// no weights, so this weight changes the policy only through the clipping of the common gradient. Recurrent
    /// networks share all weights except those of their heads.
    pub vf_coef: f64,
    /// Global norm that longer gradients are scaled down to, above 0 (default: `0.5`).
    pub max_grad_norm: f64,
    /// λ: each gradient step reduces every weight by the share learning rate · λ, not negative and below 1 /
    /// `learning_rate` (default: `0`). Larger keeps outputs closer to 0, and deviations of continuous actions closer to 1.
    /// Written only if it is not the default, so that older settings stay the same.
    #[serde(skip_serializing_if = "is_zero")]
    pub weight_decay: f64,
    /// Decay per update of RMSProp's average of squared gradients, 0 … 1 (default: `0.99`).
    pub rms_alpha: f64,
    /// RMSProp's ε, added to that average inside the root, above 0 (default: `1e-5`). Limits the step of weights with
    /// small gradients.
    pub rms_eps: f64,
    /// Whether V(final observation) follows the last reward of a truncated episode (default: `true`; paper: `false`).
    /// `false` treats a time limit as the task's end, as the reference does.
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
            weight_decay: 0.0,
            rms_alpha: 0.99,
            rms_eps: 1e-5,
            bootstrap_truncation: true,
        }
    }
}

impl A2cConfig {
    /// Refuses values outside their ranges, NaN included.
    ///
    /// # Errors
    /// [`SettingError`].
    pub fn validate(&self) -> Result<(), SettingError> {
        check_positive("learning_rate", self.learning_rate)?;
        check_count("n_steps", self.n_steps)?;
        check_fraction("gamma", self.gamma)?;
        check_not_negative("ent_coef", self.ent_coef)?;
        check_not_negative("vf_coef", self.vf_coef)?;
        check_positive("max_grad_norm", self.max_grad_norm)?;
        check_weight_decay(self.weight_decay, self.learning_rate)?;
        check("rms_alpha", self.rms_alpha, (0.0..1.0).contains(&self.rms_alpha), "at least 0 and below 1")?;
        check_positive("rms_eps", self.rms_eps)
    }
}

/// Settings of PPO. The defaults are the paper's, which searches `learning_rate` and `n_steps`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct PpoConfig {
    /// Step size of Adam, above 0 (default: `3e-4`). Larger learns faster, until the policy collapses.
    pub learning_rate: f64,
    /// The schedule of the learning rate: "constant", or "linear" to 0 over the training (default: `"constant"`).
    pub learning_rate_schedule: Schedule,
    /// T: steps of each environment between two updates, at least 1 (default: `128`).
    pub n_steps: usize,
    /// Passes over a rollout, 1 … 1000 (default: `10`). More takes more from each sample, until clipping stops it.
    pub n_epochs: usize,
    /// Minibatches in a pass (default: `1`). More means more and noisier steps. T·N must be a multiple of it; with a
    /// recurrent policy, whose minibatches are of whole environments, N.
    pub n_minibatches: usize,
    /// Discount factor per step, 0 … 1 (default: `0.99`). Rewards 1/(1-γ) steps ahead count for about a third.
    pub gamma: f64,
    /// λ of generalised advantage estimation, 0 … 1 (default: `0.95`). Smaller trusts the values more than the returns.
    pub gae_lambda: f64,
    /// Clipping range of the ratio of new to old probabilities, above 0 (default: `0.2`).
    pub clip_range: f64,
    /// Clipping range of the value's change from the rollout's, in units of the normalised reward; 0 = no clipping
    /// (default: `0.2`).
    pub clip_range_vf: f64,
    /// Whether advantages get mean 0 and standard deviation 1 in every minibatch (default: `true`).
    pub normalize_advantage: bool,
    /// Weight of the entropy in nats, not negative (default: `0`). Larger keeps actions random for longer.
    pub ent_coef: f64,
    /// Weight of the KL divergence of the new from the acting policy, in nats, not negative (default: `0`). Larger holds
    /// the policy back where clipping does not. Packer et al. (2018) search it for RL².
    pub kl_coef: f64,
    /// Weight of the value loss, which is the mean squared error; not negative (default: `0.5`; paper: `0.25`, because
    /// the authors' code gives half of the squared error the weight 0.5). Feed-forward policy and value networks share
    /// no weights, so this weight changes the policy only through the clipping of the common gradient. Recurrent
    /// networks share all weights except those of their heads.
    pub vf_coef: f64,
    /// Global norm that longer gradients are scaled down to, above 0 (default: `0.5`).
    pub max_grad_norm: f64,
    /// λ: each gradient step reduces every weight by the share learning rate · λ, not negative and below 1 /
    /// `learning_rate` (default: `0`). Larger keeps outputs closer to 0, and deviations of continuous actions closer to 1.
    /// Written only if it is not the default, so that older settings stay the same.
    #[serde(skip_serializing_if = "is_zero")]
    pub weight_decay: f64,
    /// Adam's ε, above 0 (default: `1e-5`). Limits the step of weights with small gradients.
    pub adam_eps: f64,
    /// Whether V(final observation) follows the last reward of a truncated episode (default: `true`; paper: `false`).
    /// `false` treats a time limit as the task's end, as the reference does.
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
            clip_range_vf: 0.2,
            normalize_advantage: true,
            ent_coef: 0.0,
            kl_coef: 0.0,
            vf_coef: 0.5,
            max_grad_norm: 0.5,
            weight_decay: 0.0,
            adam_eps: 1e-5,
            bootstrap_truncation: true,
        }
    }
}

impl PpoConfig {
    /// Refuses values outside their ranges, NaN included.
    ///
    /// # Errors
    /// [`SettingError`].
    pub fn validate(&self) -> Result<(), SettingError> {
        check_positive("learning_rate", self.learning_rate)?;
        check_count("n_steps", self.n_steps)?;
        check_epochs("n_epochs", self.n_epochs)?;
        check_count("n_minibatches", self.n_minibatches)?;
        check_fraction("gamma", self.gamma)?;
        check_fraction("gae_lambda", self.gae_lambda)?;
        check_positive("clip_range", self.clip_range)?;
        check_not_negative("clip_range_vf", self.clip_range_vf)?;
        check_not_negative("ent_coef", self.ent_coef)?;
        check_not_negative("kl_coef", self.kl_coef)?;
        check_not_negative("vf_coef", self.vf_coef)?;
        check_positive("max_grad_norm", self.max_grad_norm)?;
        check_weight_decay(self.weight_decay, self.learning_rate)?;
        check_positive("adam_eps", self.adam_eps)
    }
}

/// Settings of EPOpt. The defaults are the paper's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EpoptConfig {
    /// L: complete episodes in an iteration, 1 … 10⁶ (default: `100`).
    pub episodes_per_iteration: usize,
    /// ε: the share of worst episodes that is learned from, above 0 and at most 1 (default: `0.1`).
    pub epsilon: f64,
    /// Iterations at the start that learn from all episodes, ε = 1 (default: `100`).
    pub full_iterations: u64,
    /// The quantity that ranks episodes: "raw", the undiscounted return, or "normalized", the sum of the rewards that the
    /// policy learns from (default: `"raw"`; paper: `"normalized"`). The divisor of normalised rewards changes during an
    /// iteration, so the rank of equal episodes depends on their order.
    pub rank_by: Ranking,
    /// Whether each kept episode has an update of its own, one after the other, in place of one update on all (default:
    /// `false`; paper: `true` with RC). PPO takes all its epochs over the row of episodes.
    pub update_per_episode: bool,
}

/// The quantity by which EPOpt ranks episodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ranking {
    /// The undiscounted return.
    #[default]
    Raw,
    /// The undiscounted sum of normalised rewards.
    Normalized,
}

impl Default for EpoptConfig {
    fn default() -> Self {
        EpoptConfig {
            episodes_per_iteration: 100,
            epsilon: 0.1,
            full_iterations: 100,
            rank_by: Ranking::Raw,
            update_per_episode: false,
        }
    }
}

impl EpoptConfig {
    /// Refuses values outside their ranges, NaN included.
    ///
    /// # Errors
    /// [`SettingError`].
    pub fn validate(&self) -> Result<(), SettingError> {
        check_episodes("episodes_per_iteration", self.episodes_per_iteration)?;
        check("epsilon", self.epsilon, self.epsilon > 0.0 && self.epsilon <= 1.0, "above 0 and at most 1")
    }
}

/// Settings of RL², Duan et al. (2016), arXiv:1611.02779, in addition to those of the A2C or PPO that it wraps.
///
/// A trial is N episodes in one drawn environment. The policy is recurrent and keeps its memory from one episode of a trial
/// to the next. Beside the observation it gets its last action, reward and done flag (the learner's `Inputs`). Returns and
/// advantages run across the episodes of a trial. So the best policy is one that uses a trial's first steps to find out
/// which environment it is in. Updates are those of A2C or PPO, with [`kl_coef`](PpoConfig::kl_coef) for RL²-PPO; only the
/// collection of rollouts differs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
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
    ///
    /// # Errors
    /// [`SettingError`].
    pub fn validate(&self) -> Result<(), SettingError> {
        check_episodes("episodes_per_trial", self.episodes_per_trial as usize)
    }
}

/// `Ok` if `value` is finite and `accepted`.
fn check(name: &'static str, value: f64, accepted: bool, expected: &'static str) -> Result<(), SettingError> {
    if value.is_finite() && accepted { Ok(()) } else { Err(SettingError { name, got: value.to_string(), expected }) }
}

/// `Ok` if `value` is at least 1. A rollout's size limits it from above.
fn check_count(name: &'static str, value: usize) -> Result<(), SettingError> {
    if value > 0 { Ok(()) } else { Err(SettingError { name, got: value.to_string(), expected: "at least 1" }) }
}

/// `Ok` if `value` is a number of episodes that can be waited for.
fn check_episodes(name: &'static str, value: usize) -> Result<(), SettingError> {
    if (1..=1_000_000).contains(&value) {
        return Ok(());
    }
    Err(SettingError { name, got: value.to_string(), expected: "between 1 and 1000000" })
}

/// `Ok` if `value` is a number of passes over a rollout that can be waited for.
fn check_epochs(name: &'static str, value: usize) -> Result<(), SettingError> {
    if (1..=1000).contains(&value) {
        return Ok(());
    }
    Err(SettingError { name, got: value.to_string(), expected: "between 1 and 1000" })
}

/// `Ok` if `value` is a positive number.
fn check_positive(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, value > 0.0, "a positive number")
}

/// `Ok` if `value` is a number that is not negative.
fn check_not_negative(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, value >= 0.0, "a number that is not negative")
}

/// `Ok` if a gradient step does not take the whole weight.
fn check_weight_decay(weight_decay: f64, learning_rate: f64) -> Result<(), SettingError> {
    let is_decay = weight_decay >= 0.0 && weight_decay * learning_rate < 1.0;
    check("weight_decay", weight_decay, is_decay, "a number that is not negative, and below 1 / learning_rate")
}

/// `Ok` if `value` is between 0 and 1.
fn check_fraction(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, (0.0..=1.0).contains(&value), "between 0 and 1")
}
