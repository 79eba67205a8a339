//! Advantage actor-critic.

use serde::{Deserialize, Serialize};
use tch::Kind;

use super::batch::Batch;
use super::optimiser::{Descent, RmsProp};
use super::{
    Algorithm, AlgorithmState, Experience, Schedule, UpdateStats, check_count, check_fraction, check_not_negative,
    check_positive, check_rollout, explained_variance, scalars,
};
use crate::error::{Result, check};
use crate::loss;
use crate::policy::Policy;
use crate::rollout::{Rollout, n_step_returns};

/// Settings of [`A2c`]. The defaults are those of OpenAI Baselines; the paper searches `learning_rate`, `n_steps` and
/// `ent_coef`, for which `perturb train` has defaults of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct A2cConfig {
    /// Step size of RMSProp, above 0 (default: `7e-4`). Larger learns faster, until the policy collapses.
    pub learning_rate: f64,
    /// How the learning rate moves: "linear" to 0 over the training, or "constant" (default: `"linear"`).
    pub learning_rate_schedule: Schedule,
    /// T: steps of each environment between two updates, at least 1 (default: `5`). More makes returns less biased, their
    /// variance larger and updates rarer.
    pub n_steps: usize,
    /// Discount factor per step, 0 … 1 (default: `0.99`). Rewards 1/(1-γ) steps ahead count for about a third.
    pub gamma: f64,
    /// Weight of the entropy in nats, not negative (default: `0.01`). Larger keeps actions random for longer.
    pub ent_coef: f64,
    /// Weight of the value loss, not negative (default: `0.5`). Feed-forward policy and value networks share no weights, so
    /// it acts through the clipping of the common gradient only; recurrent ones share all but their heads.
    pub vf_coef: f64,
    /// Global norm that longer gradients are scaled down to, above 0 (default: `0.5`).
    pub max_grad_norm: f64,
    /// Decay per update of RMSProp's average of squared gradients, 0 … 1 (default: `0.99`).
    pub rms_alpha: f64,
    /// RMSProp's ε, added to that average inside the root, above 0 (default: `1e-5`). Limits the step of weights with
    /// small gradients.
    pub rms_eps: f64,
    /// Whether V(final observation) follows the last reward of a truncated episode (default: `true`). `false` treats a
    /// time limit as the task's end, as the reference does.
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
    /// Refuses values outside their ranges, NaN included.
    pub fn validate(&self) -> Result<()> {
        check_positive("learning_rate", self.learning_rate)?;
        check_count("n_steps", self.n_steps)?;
        check_fraction("gamma", self.gamma)?;
        check_not_negative("ent_coef", self.ent_coef)?;
        check_not_negative("vf_coef", self.vf_coef)?;
        check_positive("max_grad_norm", self.max_grad_norm)?;
        check("rms_alpha", self.rms_alpha, (0.0..1.0).contains(&self.rms_alpha), "at least 0 and below 1")?;
        check_positive("rms_eps", self.rms_eps)
    }
}

/// Synchronous advantage actor-critic, Mnih et al. (2016), arXiv:1602.01783, without asynchrony: one gradient step a
/// rollout on all its T·N samples,
///
/// loss = policy gradient - ent_coef · mean entropy + vf_coef · mean (V - R)²,
///
/// with [`n_step_returns`] R and advantages R - V(s_t), where V(s_t) is the rollout's. RMSProp is TensorFlow's form:
/// averages start at 1 and ε is inside the root.
pub struct A2c {
    config: A2cConfig,
    descent: Descent,
}

impl A2c {
    /// Checks the settings and starts with fresh optimiser state for `policy`.
    pub fn new(config: A2cConfig, policy: &Policy) -> Result<Self> {
        config.validate()?;
        let optimiser = RmsProp::new(config.rms_alpha, config.rms_eps, policy.n_weights());
        let descent = Descent::new(optimiser, config.max_grad_norm, policy);
        Ok(A2c { config, descent })
    }
}

impl Algorithm for A2c {
    fn experience(&self) -> Experience {
        Experience::Steps(self.config.n_steps)
    }

    fn update(&mut self, policy: &mut Policy, rollout: &Rollout, progress_remaining: f64) -> Result<UpdateStats> {
        let A2cConfig { gamma, ent_coef, vf_coef, bootstrap_truncation, .. } = self.config;
        check_rollout(rollout, policy, self.config.n_steps)?;
        let learning_rate = self.config.learning_rate_schedule.at(self.config.learning_rate, progress_remaining)?;
        let estimates = n_step_returns(&rollout.trajectories()?, gamma, bootstrap_truncation);
        let batch = Batch::new(rollout, policy, &estimates)?;
        let evaluated = policy.evaluate(&batch.sequences, &batch.actions);
        let policy_loss = loss::policy_gradient(&evaluated.log_probs, &batch.advantages()?);
        let value_loss = loss::value(&evaluated.values, &batch.returns()?);
        let entropy_loss = -evaluated.entropy.mean(Kind::Float);
        let loss = &policy_loss + &entropy_loss * ent_coef + &value_loss * vf_coef;
        let grad_norm = self.descent.step(policy, &evaluated, &loss, learning_rate)?;
        let [policy_gradient_loss, value_loss, entropy_loss, loss] =
            scalars([&policy_loss, &value_loss, &entropy_loss, &loss])?;
        Ok(UpdateStats {
            learning_rate,
            policy_gradient_loss,
            value_loss,
            entropy_loss,
            loss,
            approx_kl: None,
            kl_divergence: None,
            clip_fraction: None,
            clip_range: None,
            explained_variance: explained_variance(rollout, &estimates),
            grad_norm,
            n_updates: self.descent.n_updates(),
            std: policy.mean_std(),
            selection: None,
        })
    }

    fn state(&self) -> AlgorithmState {
        let (n_updates, optimiser) = (self.descent.n_updates(), self.descent.state());
        AlgorithmState { n_updates, iterations: 0, optimiser, rng: None }
    }

    fn load_state(&mut self, state: &AlgorithmState) -> Result<()> {
        self.descent.load_state(state.n_updates, &state.optimiser)
    }
}
