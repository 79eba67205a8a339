//! Proximal policy optimisation.

use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tch::Kind;

use super::batch::Batch;
use super::optimiser::{Adam, Descent};
use super::{
    Algorithm, AlgorithmState, Experience, Schedule, UpdateStats, check_count, check_fraction, check_not_negative,
    check_positive, check_rollout, explained_variance, scalars,
};
use crate::error::{Error, Result};
use crate::loss;
use crate::policy::Policy;
use crate::random::{Purpose, stream, uniform};
use crate::rollout::{Rollout, gae};

/// Settings of [`Ppo`]. The defaults are the paper's, which searches `learning_rate` and `n_steps`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PpoConfig {
    /// Step size of Adam, above 0 (default: `3e-4`). Larger learns faster, until the policy collapses.
    pub learning_rate: f64,
    /// How the learning rate moves: "constant", or "linear" to 0 over the training (default: `"constant"`).
    pub learning_rate_schedule: Schedule,
    /// T: steps of each environment between two updates, at least 1 (default: `128`).
    pub n_steps: usize,
    /// Passes over a rollout, at least 1 (default: `10`). More takes more from each sample, until clipping stops it.
    pub n_epochs: usize,
    /// Minibatches in a pass (default: `1`). More means more and noisier steps. T·N must be a multiple of it; with a
    /// recurrent policy, whose minibatches are of whole environments, N.
    pub n_minibatches: usize,
    /// Discount factor per step, 0 … 1 (default: `0.99`). Rewards 1/(1-γ) steps ahead count for about a third.
    pub gamma: f64,
    /// λ of generalised advantage estimation, 0 … 1 (default: `0.95`). Smaller trusts the values more than the returns.
    pub gae_lambda: f64,
    /// How far the ratio of new to old probability may gain from moving away from 1, above 0 (default: `0.2`).
    pub clip_range: f64,
    /// How far a value may gain from moving away from the rollout's, in units of the normalised reward; 0 = as far as it
    /// wants (default: `0.2`).
    pub clip_range_vf: f64,
    /// Whether advantages get mean 0 and standard deviation 1 in every minibatch (default: `true`).
    pub normalize_advantage: bool,
    /// Weight of the entropy in nats, not negative (default: `0`). Larger keeps actions random for longer.
    pub ent_coef: f64,
    /// Weight of the KL divergence of the new from the acting policy, in nats, not negative (default: `0`). Larger holds
    /// the policy back where clipping does not. Packer et al. (2018) search it for RL².
    pub kl_coef: f64,
    /// Weight of the value loss, not negative (default: `0.5`). Feed-forward policy and value networks share no weights, so
    /// it acts through the clipping of the common gradient only; recurrent ones share all but their heads.
    pub vf_coef: f64,
    /// Global norm that longer gradients are scaled down to, above 0 (default: `0.5`).
    pub max_grad_norm: f64,
    /// Adam's ε, above 0 (default: `1e-5`). Limits the step of weights with small gradients.
    pub adam_eps: f64,
    /// Whether V(final observation) follows the last reward of a truncated episode (default: `true`). `false` treats a
    /// time limit as the task's end, as the reference does.
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
            adam_eps: 1e-5,
            bootstrap_truncation: true,
        }
    }
}

impl PpoConfig {
    /// Refuses values outside their ranges, NaN included.
    pub fn validate(&self) -> Result<()> {
        check_positive("learning_rate", self.learning_rate)?;
        check_count("n_steps", self.n_steps)?;
        check_count("n_epochs", self.n_epochs)?;
        check_count("n_minibatches", self.n_minibatches)?;
        check_fraction("gamma", self.gamma)?;
        check_fraction("gae_lambda", self.gae_lambda)?;
        check_positive("clip_range", self.clip_range)?;
        check_not_negative("clip_range_vf", self.clip_range_vf)?;
        check_not_negative("ent_coef", self.ent_coef)?;
        check_not_negative("kl_coef", self.kl_coef)?;
        check_not_negative("vf_coef", self.vf_coef)?;
        check_positive("max_grad_norm", self.max_grad_norm)?;
        check_positive("adam_eps", self.adam_eps)
    }
}

/// Proximal policy optimisation with a clipped ratio, Schulman et al. (2017), arXiv:1707.06347: `n_epochs` passes over a
/// rollout's T·N samples, each in `n_minibatches` random parts with one gradient step (of samples or, for a recurrent
/// policy, of environments),
///
/// loss = clipped surrogate - ent_coef · mean entropy + vf_coef · clipped value loss + kl_coef · mean KL(π_old ‖ π),
///
/// with [`gae`]'s advantages and returns, computed once from the rollout's values, and the acting policy π_old.
pub struct Ppo {
    config: PpoConfig,
    descent: Descent,
    rng: ChaCha8Rng,
}

/// What a gradient step reports: policy loss, value loss, entropy loss, loss, approximate KL, clip fraction, KL divergence,
/// gradient norm.
type Report = [f64; 8];

impl Ppo {
    /// Checks the settings and starts with fresh optimiser state for `policy`; `seed` fixes the order of minibatches.
    pub fn new(config: PpoConfig, policy: &Policy, seed: u64) -> Result<Self> {
        config.validate()?;
        let optimiser = Adam::new(config.adam_eps, policy.n_weights());
        let descent = Descent::new(optimiser, config.max_grad_norm, policy);
        Ok(Ppo { config, descent, rng: stream(seed, Purpose::Minibatches) })
    }

    /// One gradient step on `batch`.
    fn step(&mut self, policy: &mut Policy, batch: &Batch, learning_rate: f64) -> Result<Report> {
        let PpoConfig { clip_range, clip_range_vf, ent_coef, kl_coef, vf_coef, .. } = self.config;
        let (advantages, returns) = (batch.advantages()?, batch.returns()?);
        let normalized = self.config.normalize_advantage.then(|| loss::normalize_advantages(&advantages));
        let advantages = normalized.as_ref().unwrap_or(&advantages);
        let evaluated = policy.evaluate(&batch.sequences, &batch.actions);
        let surrogate = loss::clipped_surrogate(&evaluated.log_probs, &batch.old_log_probs()?, advantages, clip_range);
        let value_loss = if clip_range_vf > 0.0 {
            loss::clipped_value(&evaluated.values, &batch.old_values()?, &returns, clip_range_vf)
        } else {
            loss::value(&evaluated.values, &returns)
        };
        let entropy_loss = -evaluated.entropy.mean(Kind::Float);
        let mut loss = &surrogate.loss + &entropy_loss * ent_coef + &value_loss * vf_coef;
        let kl_divergence = match batch.acting()? {
            Some(acting) => {
                let kl_divergence = acting.divergence_to(&evaluated.distributions).mean(Kind::Float);
                loss += &kl_divergence * kl_coef;
                kl_divergence
            }
            None => surrogate.approx_kl.zeros_like(),
        };
        let grad_norm = self.descent.step(policy, &evaluated, &loss, learning_rate)?;
        let [policy, value, entropy, loss, kl, clip, kl_divergence] = scalars([
            &surrogate.loss,
            &value_loss,
            &entropy_loss,
            &loss,
            &surrogate.approx_kl,
            &surrogate.clip_fraction,
            &kl_divergence,
        ])?;
        Ok([policy, value, entropy, loss, kl, clip, kl_divergence, grad_norm])
    }
}

impl Algorithm for Ppo {
    fn experience(&self) -> Experience {
        Experience::Steps(self.config.n_steps)
    }

    fn update(&mut self, policy: &mut Policy, rollout: &Rollout, progress_remaining: f64) -> Result<UpdateStats> {
        let PpoConfig { n_epochs, n_minibatches, .. } = self.config;
        check_rollout(rollout, policy, self.config.n_steps)?;
        let PpoConfig { gamma, gae_lambda, kl_coef, bootstrap_truncation, .. } = self.config;
        let estimates = gae(&rollout.trajectories()?, gamma, gae_lambda, bootstrap_truncation);
        let mut batch = Batch::new(rollout, policy, &estimates)?;
        if kl_coef > 0.0 {
            batch.remember_acting(policy);
        }
        let count = batch.sequences.count() as usize;
        if !count.is_multiple_of(n_minibatches) {
            let got = format!("{n_minibatches}, to part {count}");
            let expected = "a divisor of n_steps times num_envs, or of num_envs if the policy is recurrent";
            return Err(Error::Setting { name: "n_minibatches", got, expected });
        }
        let learning_rate = self.config.learning_rate_schedule.at(self.config.learning_rate, progress_remaining)?;

        let mut sums: Report = Report::default();
        let mut add = |report: Report| sums.iter_mut().zip(report).for_each(|(sum, x)| *sum += x);
        let mut indices: Vec<i64> = (0..count as i64).collect();
        for _ in 0..n_epochs {
            if n_minibatches == 1 {
                // The order of a mean's samples does not matter.
                add(self.step(policy, &batch, learning_rate)?);
                continue;
            }
            shuffle(&mut indices, &mut self.rng);
            for part in indices.chunks_exact(count / n_minibatches) {
                add(self.step(policy, &batch.select(part)?, learning_rate)?);
            }
        }
        let [policy_gradient_loss, value_loss, entropy_loss, loss, approx_kl, clip_fraction, kl_divergence, grad_norm] =
            sums.map(|sum| sum / (n_epochs * n_minibatches) as f64);
        Ok(UpdateStats {
            learning_rate,
            policy_gradient_loss,
            value_loss,
            entropy_loss,
            loss,
            approx_kl: Some(approx_kl),
            kl_divergence: (kl_coef > 0.0).then_some(kl_divergence),
            clip_fraction: Some(clip_fraction),
            clip_range: Some(self.config.clip_range),
            explained_variance: explained_variance(rollout, &estimates),
            grad_norm,
            n_updates: self.descent.n_updates(),
            std: policy.mean_std(),
            selection: None,
        })
    }

    fn state(&self) -> AlgorithmState {
        let (n_updates, optimiser) = (self.descent.n_updates(), self.descent.state());
        AlgorithmState { n_updates, iterations: 0, optimiser, rng: Some(self.rng.clone()) }
    }

    fn load_state(&mut self, state: &AlgorithmState) -> Result<()> {
        let missing = Error::Setting { name: "rng", got: "missing".to_owned(), expected: "the saved minibatch stream" };
        let rng = state.rng.clone().ok_or(missing)?;
        self.descent.load_state(state.n_updates, &state.optimiser)?;
        self.rng = rng;
        Ok(())
    }
}

/// Puts `indices` in random order (Fisher and Yates).
fn shuffle(indices: &mut [i64], rng: &mut ChaCha8Rng) {
    for last in (1..indices.len()).rev() {
        indices.swap(last, (uniform(rng) * (last + 1) as f64) as usize);
    }
}
