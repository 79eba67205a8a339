//! The settings of each algorithm.

use serde::{Deserialize, Serialize};

use super::{SettingError, is_zero};

/// The schedule of the learning rate over a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// The learning rate stays constant.
    Constant,
    /// The learning rate falls linearly with the number of steps. It reaches 0 at the maximum number of steps: the
    /// budget's episodes times the step limit. A training whose episodes end before the step limit therefore ends at a
    /// rate above 0. With EPOpt's `update_per_episode`, the rate falls with the number of episodes, to 0 at the budget.
    Linear,
}

impl Schedule {
    /// Returns the learning rate at a point of the training. `progress_remaining` is the share of the maximum number of
    /// steps (or of the budget's episodes) that is left: 1 at the start, and 0 when nothing is left.
    ///
    /// # Errors
    /// [`SettingError`] if `progress_remaining` is not between 0 and 1.
    pub fn at(self, learning_rate: f64, progress_remaining: f64) -> Result<f64, SettingError> {
        let in_range = (0.0..=1.0).contains(&progress_remaining);
        check("progress_remaining", progress_remaining, in_range, "between 0 and 1")?;
        Ok(match self {
            Schedule::Constant => learning_rate,
            Schedule::Linear => learning_rate * progress_remaining,
        })
    }
}

/// Settings of A2C. The defaults are those of OpenAI Baselines. Packer et al. (2018) tune `learning_rate`, `n_steps`
/// and `ent_coef`; `perturb train` has other defaults for these three.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct A2cConfig {
    /// Step size of RMSProp, above 0 (default: `7e-4`). A larger value learns faster, but if it is too large the policy
    /// collapses.
    pub learning_rate: f64,
    /// The schedule of the learning rate: "linear", which falls to 0 over the budget's episodes times the step limit,
    /// or "constant" (default: `"linear"`).
    pub learning_rate_schedule: Schedule,
    /// T, the number of steps of each environment between two updates, at least 1 (default: `5`). A larger value makes
    /// returns less biased but increases their variance, and makes updates rarer.
    pub n_steps: usize,
    /// Discount factor γ per step, 0 … 1 (default: `0.99`). A reward 1/(1-γ) steps ahead has about a third of the
    /// weight of an immediate reward.
    pub gamma: f64,
    /// Weight of the entropy (in nats) in the loss, not negative (default: `0.01`). A larger value keeps actions random
    /// for longer.
    pub ent_coef: f64,
    /// Weight of the value loss, which is the mean squared error; not negative (default: `0.5`; paper: `0.25`, because
    /// the code of Packer et al. (2018) multiplies half of the squared error by 0.5). Feed-forward policy and value
    /// networks share no weights, so this setting affects the policy only through the clipping of their common
    /// gradient. Recurrent networks share all weights except those of the two heads.
    pub vf_coef: f64,
    /// Maximum global norm of the gradient, above 0 (default: `0.5`). A longer gradient is scaled down to this norm.
    pub max_grad_norm: f64,
    /// Weight decay λ: each gradient step multiplies every weight by 1 - learning rate · λ. Not negative, and below 1 /
    /// `learning_rate` (default: `0`). A larger value keeps outputs closer to 0, and standard deviations of continuous
    /// actions closer to 1. `config.toml` contains this setting only if it is not the default. Without it, the file has
    /// the same bytes as in earlier versions, which did not have the setting.
    #[serde(skip_serializing_if = "is_zero")]
    pub weight_decay: f64,
    /// Decay per update of RMSProp's running average of squared gradients, at least 0 and below 1 (default: `0.99`).
    pub rms_alpha: f64,
    /// RMSProp's ε, which is added to the average of squared gradients inside of the root, above 0 (default: `1e-5`).
    /// This limits the step of weights with small gradients.
    pub rms_eps: f64,
    /// Whether returns of truncated episodes are bootstrapped: whether the value of the final observation follows the
    /// last reward (default: `true`; paper: `false`). `false` treats the step limit as an end of the task, as in the
    /// code of Packer et al. (2018).
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
    /// Checks that all values are in their ranges, which exclude NaN.
    ///
    /// # Errors
    /// [`SettingError`] with the first value that is out of range.
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

/// Settings of PPO. The defaults are those of Packer et al. (2018), unless a field gives another value for the paper.
/// Packer et al. tune `learning_rate` and `n_steps`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct PpoConfig {
    /// Step size of Adam, above 0 (default: `3e-4`). A larger value learns faster, but if it is too large the policy
    /// collapses.
    pub learning_rate: f64,
    /// The schedule of the learning rate: "constant", or "linear", which falls to 0 over the budget's episodes times the
    /// step limit (default: `"constant"`).
    pub learning_rate_schedule: Schedule,
    /// T, the number of steps of each environment between two updates, at least 1 (default: `128`).
    pub n_steps: usize,
    /// The number of passes over a rollout in one update, 1 … 1000 (default: `10`). More passes learn more from each
    /// sample, until clipping prevents further change.
    pub n_epochs: usize,
    /// The number of minibatches in a pass (default: `1`). More minibatches give more, but noisier, gradient steps. It
    /// must divide T·N, the number of samples. With a recurrent policy it must divide N, because a minibatch then
    /// consists of whole environments.
    pub n_minibatches: usize,
    /// Discount factor γ per step, 0 … 1 (default: `0.99`). A reward 1/(1-γ) steps ahead has about a third of the
    /// weight of an immediate reward.
    pub gamma: f64,
    /// λ of generalised advantage estimation, 0 … 1 (default: `0.95`). A smaller value gives more weight to the
    /// estimated values and less to the observed rewards.
    pub gae_lambda: f64,
    /// Half-width of the clipping interval around 1 for the ratio of new to old probabilities, above 0 (default:
    /// `0.2`).
    pub clip_range: f64,
    /// Limit to the change of a value from its rollout's value, in units of the normalised reward; 0 turns clipping off
    /// (default: `0.2`).
    pub clip_range_vf: f64,
    /// Whether advantages are normalised to mean 0 and standard deviation 1 in every minibatch (default: `true`).
    pub normalize_advantage: bool,
    /// Weight of the entropy (in nats) in the loss, not negative (default: `0`). A larger value keeps actions random
    /// for longer.
    pub ent_coef: f64,
    /// Weight of the KL divergence (in nats) of the new policy from the acting policy, not negative (default: `0`). A
    /// larger value makes the policy change less, also where clipping has no effect. Packer et al. (2018) tune it for RL².
    pub kl_coef: f64,
    /// Weight of the value loss, which is the mean squared error; not negative (default: `0.5`; paper: `0.25`, because
    /// the code of Packer et al. (2018) multiplies half of the squared error by 0.5). Feed-forward policy and value
    /// networks share no weights, so this setting affects the policy only through the clipping of their common
    /// gradient. Recurrent networks share all weights except those of the two heads.
    pub vf_coef: f64,
    /// Maximum global norm of the gradient, above 0 (default: `0.5`). A longer gradient is scaled down to this norm.
    pub max_grad_norm: f64,
    /// Weight decay λ: each gradient step multiplies every weight by 1 - learning rate · λ. Not negative, and below 1 /
    /// `learning_rate` (default: `0`). A larger value keeps outputs closer to 0, and standard deviations of continuous
    /// actions closer to 1. `config.toml` contains this setting only if it is not the default. Without it, the file has
    /// the same bytes as in earlier versions, which did not have the setting.
    #[serde(skip_serializing_if = "is_zero")]
    pub weight_decay: f64,
    /// Adam's ε, above 0 (default: `1e-5`). This limits the step of weights with small gradients.
    pub adam_eps: f64,
    /// Whether returns of truncated episodes are bootstrapped: whether the value of the final observation follows the
    /// last reward (default: `true`; paper: `false`). `false` treats the step limit as an end of the task, as in the
    /// code of Packer et al. (2018).
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
    /// Checks that all values are in their ranges, which exclude NaN.
    ///
    /// # Errors
    /// [`SettingError`] with the first value that is out of range.
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

/// Settings of EPOpt. The defaults are those of Packer et al. (2018), unless a field gives another value for the paper.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EpoptConfig {
    /// L, the number of complete episodes in an iteration, 1 … 10⁶ (default: `100`).
    pub episodes_per_iteration: usize,
    /// ε, the share of episodes from which the policy learns, above 0 and at most 1 (default: `0.1`). These are the
    /// episodes with the lowest returns.
    pub epsilon: f64,
    /// The number of iterations at the start that learn from all episodes, as with ε = 1 (default: `100`).
    pub full_iterations: u64,
    /// The quantity by which episodes are ranked: "raw", the undiscounted return, or "normalized", the sum of the
    /// normalised rewards that the policy learns from (default: `"raw"`; paper: `"normalized"`). The divisor of
    /// normalised rewards changes during an iteration, so with "normalized" the rank of equal episodes depends on their
    /// order.
    pub rank_by: Ranking,
    /// Whether each of the selected episodes has a separate update, instead of one update on all of them (default:
    /// `false`; paper: `true` with RC). Each epoch of PPO then goes through all selected episodes.
    pub update_per_episode: bool,
}

/// The quantity by which EPOpt ranks episodes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ranking {
    /// The undiscounted return of the original rewards.
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
    /// Checks that all values are in their ranges, which exclude NaN.
    ///
    /// # Errors
    /// [`SettingError`] with the first value that is out of range.
    pub fn validate(&self) -> Result<(), SettingError> {
        check_episodes("episodes_per_iteration", self.episodes_per_iteration)?;
        check("epsilon", self.epsilon, self.epsilon > 0.0 && self.epsilon <= 1.0, "above 0 and at most 1")
    }
}

/// Settings of RL², Duan et al. (2016), arXiv:1611.02779. They are added to the settings of A2C or PPO, which RL²
/// wraps.
///
/// A trial consists of N episodes with the same drawn parameters. The policy is recurrent and keeps its memory from one
/// episode of a trial to the next. Besides the observation, the policy gets its last action, reward and done flag
/// (`perturb_policy::Inputs`). Returns and advantages continue across the episodes of a trial. Therefore the best
/// policy uses the first steps of a trial to find out which parameters the environment has. Updates are those of A2C or
/// PPO, with [`kl_coef`](PpoConfig::kl_coef) for RL²-PPO; only the collection of rollouts differs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Rl2Config {
    /// N, the number of episodes in a trial, 1 … 10⁶ (default: `2`; Packer et al. (2018) also try 1 and 5). Tests count
    /// only the last episode of each trial.
    pub episodes_per_trial: u32,
}

impl Default for Rl2Config {
    fn default() -> Self {
        Rl2Config { episodes_per_trial: 2 }
    }
}

impl Rl2Config {
    /// Checks that all values are in their ranges, which exclude NaN.
    ///
    /// # Errors
    /// [`SettingError`] with the first value that is out of range.
    pub fn validate(&self) -> Result<(), SettingError> {
        check_episodes("episodes_per_trial", self.episodes_per_trial as usize)
    }
}

/// Checks that `value` is finite and that `accepted` is true.
fn check(name: &'static str, value: f64, accepted: bool, expected: &'static str) -> Result<(), SettingError> {
    if value.is_finite() && accepted { Ok(()) } else { Err(SettingError { name, got: value.to_string(), expected }) }
}

/// Checks that `value` is at least 1. The maximum size of a rollout limits it from above.
fn check_count(name: &'static str, value: usize) -> Result<(), SettingError> {
    if value > 0 { Ok(()) } else { Err(SettingError { name, got: value.to_string(), expected: "at least 1" }) }
}

/// Checks a number of episodes. The upper limit keeps an iteration from taking practically forever.
fn check_episodes(name: &'static str, value: usize) -> Result<(), SettingError> {
    if (1..=1_000_000).contains(&value) {
        return Ok(());
    }
    Err(SettingError { name, got: value.to_string(), expected: "between 1 and 1000000" })
}

/// Checks a number of passes over a rollout. The upper limit keeps an update from taking practically forever.
fn check_epochs(name: &'static str, value: usize) -> Result<(), SettingError> {
    if (1..=1000).contains(&value) {
        return Ok(());
    }
    Err(SettingError { name, got: value.to_string(), expected: "between 1 and 1000" })
}

/// Checks that `value` is positive.
fn check_positive(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, value > 0.0, "a positive number")
}

/// Checks that `value` is not negative.
fn check_not_negative(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, value >= 0.0, "a number that is not negative")
}

/// Checks that weight decay takes less than the whole weight in a gradient step.
fn check_weight_decay(weight_decay: f64, learning_rate: f64) -> Result<(), SettingError> {
    let is_decay = weight_decay >= 0.0 && weight_decay * learning_rate < 1.0;
    check("weight_decay", weight_decay, is_decay, "a number that is not negative, and below 1 / learning_rate")
}

/// Checks that `value` is between 0 and 1.
fn check_fraction(name: &'static str, value: f64) -> Result<(), SettingError> {
    check(name, value, (0.0..=1.0).contains(&value), "between 0 and 1")
}
