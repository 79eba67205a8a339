//! Proximal policy optimisation.

use perturb_study::settings::{PpoConfig, SettingError};
use rand_chacha::ChaCha8Rng;
use tch::Kind;

use super::batch::Batch;
use super::optimiser::{Adam, Descent};
use super::{Algorithm, AlgorithmState, Experience, UpdateStats, check_rollout, explained_variance, scalars};
use crate::error::Result;
use crate::loss;
use crate::policy::Policy;
use crate::rollout::{Rollout, gae};
use perturb_study::random::{Purpose, stream, uniform};

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
            return Err(SettingError { name: "n_minibatches", got, expected }.into());
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
        let missing = SettingError { name: "rng", got: "missing".to_owned(), expected: "the saved minibatch stream" };
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
