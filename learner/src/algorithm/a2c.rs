//! Advantage actor-critic.

use perturb_study::settings::A2cConfig;
use tch::Kind;

use super::batch::Batch;
use super::optimiser::{Descent, RmsProp};
use super::{Algorithm, AlgorithmState, Experience, UpdateStats, check_rollout, explained_variance, scalars};
use crate::error::Result;
use crate::loss;
use crate::policy::Policy;
use crate::rollout::{Rollout, n_step_returns};

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
