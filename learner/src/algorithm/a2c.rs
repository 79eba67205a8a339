//! Advantage actor-critic (A2C).

use perturb_policy::{CollectUntil, Losses, Objective, Optimiser, Surrogate, UpdateRule};
use perturb_settings::A2cConfig;

use super::watch::UpdateWatch;
use super::{Algorithm, AlgorithmState, BaseAlgorithm, UpdateStats, check_rollout, explained_variance};
use crate::error::Result;
use crate::policy::TrainablePolicy;
use crate::rollout::{Estimates, RolloutBuffer, Trajectories};

/// Advantage actor-critic (A2C), the synchronous variant of the algorithm of Mnih et al. (2016), arXiv:1602.01783. It
/// takes one gradient step per rollout, on all its T·N samples, with
///
/// loss = policy gradient - ent_coef · mean entropy + vf_coef · mean (V - R)²,
///
/// where R are the [`n_step_returns`], and the policy gradient uses the advantages R - V(s_t). V(s_t) in the advantages
/// is the value that the rollout recorded. The optimiser is RMSProp in TensorFlow's form: its averages start at 1, and
/// ε is inside the square root.
pub struct A2c {
    config: A2cConfig,
    optimiser: Optimiser,
}

impl A2c {
    /// Returns the algorithm with a new optimiser for the weights of `policy`. Returns an error for an invalid setting.
    pub fn new(config: A2cConfig, policy: &TrainablePolicy) -> Result<Self> {
        config.validate()?;
        let n_weights = policy.flat_weights().len();
        let optimiser = UpdateRule::rms_prop(config.rms_alpha, config.rms_eps, n_weights);
        let optimiser = Optimiser::new(optimiser, config.max_grad_norm).with_weight_decay(config.weight_decay);
        Ok(A2c { config, optimiser })
    }
}

impl Algorithm for A2c {
    fn collect_until(&self) -> CollectUntil {
        CollectUntil::Steps(self.config.n_steps)
    }

    fn update(
        &mut self,
        policy: &mut TrainablePolicy,
        rollout: &RolloutBuffer,
        progress_remaining: f64,
    ) -> Result<UpdateStats> {
        self.update_many(policy, &[rollout], progress_remaining)
    }

    fn state(&self) -> AlgorithmState {
        let n_updates = self.optimiser.n_updates();
        let optimiser = self.optimiser.state();
        AlgorithmState { n_updates, iterations: 0, optimiser, rng: None }
    }

    fn load_state(&mut self, state: &AlgorithmState) -> Result<()> {
        Ok(self.optimiser.load_state(state.n_updates, &state.optimiser)?)
    }
}

impl BaseAlgorithm for A2c {
    fn update_many(
        &mut self,
        policy: &mut TrainablePolicy,
        rollouts: &[&RolloutBuffer],
        progress_remaining: f64,
    ) -> Result<UpdateStats> {
        let A2cConfig { gamma, ent_coef, vf_coef, bootstrap_truncation, .. } = self.config;
        let learning_rate = self.config.learning_rate_schedule.at(self.config.learning_rate, progress_remaining)?;
        let objective = Objective {
            surrogate: Surrogate::PolicyGradient,
            normalize_advantages: false,
            ent_coef,
            vf_coef,
            value_clip_range: None,
            kl_coef: 0.0,
        };
        let mut estimates: Vec<Estimates> = Vec::with_capacity(rollouts.len());
        let mut losses = Losses::default();
        let mut norms = 0.0;
        let mut watch = UpdateWatch::new(&policy.stop, rollouts.len());
        // Takes one gradient step on each rollout.
        for rollout in rollouts {
            check_rollout(rollout, policy, self.config.n_steps)?;
            let estimated = n_step_returns(&rollout.trajectories()?, gamma, bootstrap_truncation);
            let TrainablePolicy { weights, gradient, backend, .. } = &mut *policy;
            let batch = backend.batch(&rollout.sequences(&estimated))?;
            let loss = backend.gradient(weights, &batch, &batch.sequences(), &objective, gradient)?;
            norms += self.optimiser.step(loss.total, gradient, weights, learning_rate)?;
            backend.weights_changed();
            losses += loss;
            drop(batch);
            estimates.push(estimated);
            watch.step()?;
        }
        let mean = |sum: f64| sum / rollouts.len() as f64;
        Ok(UpdateStats {
            learning_rate,
            policy_gradient_loss: mean(losses.policy),
            value_loss: mean(losses.value),
            entropy_loss: -mean(losses.entropy),
            loss: mean(losses.total),
            approx_kl: None,
            kl_divergence: None,
            clip_fraction: None,
            clip_range: None,
            explained_variance: explained_variance(rollouts, &estimates),
            grad_norm: mean(norms),
            n_updates: self.optimiser.n_updates(),
            std: policy.mean_std(),
            selection: None,
        })
    }
}

/// n-step returns, Mnih et al. (2016), arXiv:1602.01783, algorithm S3: for t = T-1 … 0
///
/// R_t = r_t + γ V' if step t ended an episode or t = T-1, else r_t + γ R_{t+1}.
///
/// V' is the value of the observation after step t, see [`Trajectories`]. So each return sums rewards until the end of
/// the episode or the rollout. The advantages are R_t - V(s_t), the same as [`gae`](super::gae) with λ = 1.
///
/// # Panics
///
/// Panics if arrays have different lengths.
pub fn n_step_returns(trajectories: &Trajectories<'_>, gamma: f64, bootstrap_truncation: bool) -> Estimates {
    trajectories.backward(bootstrap_truncation, |step| {
        let next = if step.ended || step.last { step.next_value } else { step.next_return };
        let target = step.reward + gamma * next;
        (target - step.value, target)
    })
}
