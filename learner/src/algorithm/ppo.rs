//! Proximal policy optimisation (PPO).

use perturb_policy::random::{Purpose, stream, uniform};
use perturb_policy::{CollectUntil, GradientBatch, Losses, Objective, Optimiser, Surrogate, UpdateRule};
use perturb_settings::{PpoConfig, SettingError};
use rand_chacha::ChaCha8Rng;

use super::watch::UpdateWatch;
use super::{Algorithm, AlgorithmState, BaseAlgorithm, UpdateStats, check_rollout, explained_variance};
use crate::error::Result;
use crate::policy::TrainablePolicy;
use crate::rollout::{Estimates, RolloutBuffer, Trajectories};

/// Proximal policy optimisation (PPO) with a clipped ratio, Schulman et al. (2017), arXiv:1707.06347. An update makes
/// `n_epochs` passes over a rollout's T·N samples. Each pass divides them at random into `n_minibatches` minibatches,
/// and takes one gradient step on each. For a recurrent policy, a minibatch consists of complete sequences, for example
/// all T steps of some environments. The loss is
///
/// loss = clipped surrogate - ent_coef · mean entropy + vf_coef · clipped value loss + kl_coef · mean KL(π_old ‖ π),
///
/// where advantages and returns are those of [`gae`], computed once per update from the values that the rollout
/// recorded. π_old is the policy that acted.
pub struct Ppo {
    config: PpoConfig,
    optimiser: Optimiser,
    rng: ChaCha8Rng,
}

impl Ppo {
    /// Returns the algorithm with a new optimiser for the weights of `policy`. `seed` determines how minibatches are
    /// drawn. Returns an error for an invalid setting.
    pub fn new(config: PpoConfig, policy: &TrainablePolicy, seed: u64) -> Result<Self> {
        config.validate()?;
        let n_weights = policy.flat_weights().len();
        let optimiser = Optimiser::new(UpdateRule::adam(config.adam_eps, n_weights), config.max_grad_norm)
            .with_weight_decay(config.weight_decay);
        Ok(Ppo { config, optimiser, rng: stream(seed, Purpose::Minibatches) })
    }

    /// Returns the loss function to minimise: clipped PPO with the configured coefficients and ranges.
    fn objective(&self) -> Objective {
        let PpoConfig { clip_range, clip_range_vf, ent_coef, kl_coef, vf_coef, .. } = self.config;
        Objective {
            surrogate: Surrogate::Clipped { range: clip_range },
            normalize_advantages: self.config.normalize_advantage,
            ent_coef,
            vf_coef,
            value_clip_range: (clip_range_vf > 0.0).then_some(clip_range_vf),
            kl_coef,
        }
    }
}

impl Algorithm for Ppo {
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
        AlgorithmState { n_updates, iterations: 0, optimiser, rng: Some(self.rng.clone()) }
    }

    fn load_state(&mut self, state: &AlgorithmState) -> Result<()> {
        let missing = SettingError { name: "rng", got: "missing".to_owned(), expected: "the saved minibatch stream" };
        let rng = state.rng.clone().ok_or(missing)?;
        self.optimiser.load_state(state.n_updates, &state.optimiser)?;
        self.rng = rng;
        Ok(())
    }
}

impl BaseAlgorithm for Ppo {
    fn update_many(
        &mut self,
        policy: &mut TrainablePolicy,
        rollouts: &[&RolloutBuffer],
        progress_remaining: f64,
    ) -> Result<UpdateStats> {
        let PpoConfig { gamma, gae_lambda, n_epochs, n_minibatches, kl_coef, bootstrap_truncation, .. } = self.config;
        // Estimates advantages and returns of all rollouts before the first gradient step.
        let mut estimates: Vec<Estimates> = Vec::with_capacity(rollouts.len());
        for rollout in rollouts {
            check_rollout(rollout, policy, self.config.n_steps)?;
            estimates.push(gae(&rollout.trajectories()?, gamma, gae_lambda, bootstrap_truncation));
        }
        // Prepares a batch for each rollout. The KL penalty also needs the distributions of the policy that acted.
        let mut batches: Vec<(GradientBatch<'_>, Vec<u32>)> = Vec::with_capacity(rollouts.len());
        for (rollout, estimates) in rollouts.iter().zip(&estimates) {
            let mut batch = policy.backend.batch(&rollout.sequences(estimates))?;
            if kl_coef > 0.0 {
                policy.backend.remember_acting(&policy.weights, &mut batch)?;
            }
            let sequences = batch.sequences();
            check_minibatches(n_minibatches, sequences.len())?;
            batches.push((batch, sequences));
        }
        let learning_rate = self.config.learning_rate_schedule.at(self.config.learning_rate, progress_remaining)?;

        let objective = self.objective();
        let mut losses = Losses::default();
        let mut norms = 0.0;
        // Each epoch takes a gradient step on every minibatch of every rollout.
        let mut watch = UpdateWatch::new(&policy.stop, n_epochs * batches.len() * n_minibatches);
        for _ in 0..n_epochs {
            for (batch, sequences) in &mut batches {
                if n_minibatches > 1 {
                    shuffle(sequences, &mut self.rng); // a single minibatch needs no random order
                }
                for minibatch in sequences.chunks_exact(sequences.len() / n_minibatches) {
                    let TrainablePolicy { weights, gradient, backend, .. } = &mut *policy;
                    let loss = backend.gradient(weights, batch, minibatch, &objective, gradient)?;
                    norms += self.optimiser.step(loss.total, gradient, weights, learning_rate)?;
                    backend.weights_changed();
                    losses += loss;
                    watch.step()?;
                }
            }
        }
        let mean = |sum: f64| sum / (n_epochs * batches.len() * n_minibatches) as f64;
        Ok(UpdateStats {
            learning_rate,
            policy_gradient_loss: mean(losses.policy),
            value_loss: mean(losses.value),
            entropy_loss: -mean(losses.entropy),
            loss: mean(losses.total),
            approx_kl: Some(mean(losses.approx_kl)),
            kl_divergence: (kl_coef > 0.0).then(|| mean(losses.kl_divergence)),
            clip_fraction: Some(mean(losses.clip_fraction)),
            clip_range: Some(self.config.clip_range),
            explained_variance: explained_variance(rollouts, &estimates),
            grad_norm: mean(norms),
            n_updates: self.optimiser.n_updates(),
            std: policy.mean_std(),
            selection: None,
        })
    }
}

/// Generalised advantage estimation (GAE), Schulman et al. (2016), arXiv:1506.02438, equation 16: for t = T-1 … 0
///
/// δ_t = r_t + γ V' - V(s_t),
/// A_t = δ_t + γ λ c_t A_{t+1},
///
/// where V' is the value of the observation after step t (see [`Trajectories`]), c_t = 0 if step t ended an episode,
/// else 1, and A_T = 0. The returns are A_t + V(s_t).
///
/// # Panics
///
/// Panics if arrays have different lengths.
pub fn gae(trajectories: &Trajectories<'_>, gamma: f64, gae_lambda: f64, bootstrap_truncation: bool) -> Estimates {
    trajectories.backward(bootstrap_truncation, |step| {
        let delta = step.reward + gamma * step.next_value - step.value;
        let advantage = if step.ended { delta } else { delta + gamma * gae_lambda * step.next_advantage };
        (advantage, advantage + step.value)
    })
}

/// Returns an error if a rollout's sequences cannot be divided into equal minibatches.
fn check_minibatches(n_minibatches: usize, n_sequences: usize) -> Result<()> {
    if n_sequences.is_multiple_of(n_minibatches) {
        return Ok(());
    }
    let got = format!("{n_minibatches}, to part {n_sequences}");
    let expected = "a divisor of n_steps times num_envs, or of num_envs if the policy is recurrent";
    Err(SettingError { name: "n_minibatches", got, expected }.into())
}

/// Shuffles `indices` (Fisher and Yates).
fn shuffle(indices: &mut [u32], rng: &mut ChaCha8Rng) {
    for last in (1..indices.len()).rev() {
        indices.swap(last, (uniform(rng) * (last + 1) as f64) as usize);
    }
}
