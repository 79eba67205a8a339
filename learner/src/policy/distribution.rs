//! The two action distributions, on tensors for learning and on slices for acting.
//!
//! Categorical over logits l_j, j = 0 … n-1: log π(a) = l_a - log Σ_j exp l_j.
//! Diagonal Gaussian with means μ_i and log standard deviations log σ_i, i = 0 … A-1:
//! log π(a) = -½ Σ_i ((a_i - μ_i)/σ_i)² - Σ_i log σ_i - ½ A log 2π.

use rand_chacha::ChaCha8Rng;
use tch::{Kind, Tensor};

use crate::error::Result;
use perturb_study::random::{normal, uniform};

/// log 2π.
const LOG_TAU: f64 = 1.837_877_066_409_345_3;

/// Action distributions, one for each of B samples.
#[derive(Debug)]
pub struct Distributions {
    /// `[B, n]` logits, or `[B, A]` means; other axes may stand in place of B.
    pub(super) outputs: Tensor,
    /// `[A]` log standard deviations of continuous actions.
    pub(super) log_std: Option<Tensor>,
}

impl Distributions {
    /// The same with other outputs.
    pub(crate) fn map(&self, change: impl FnOnce(&Tensor) -> Result<Tensor>) -> Result<Self> {
        Ok(Distributions { outputs: change(&self.outputs)?, log_std: self.log_std.as_ref().map(Tensor::shallow_clone) })
    }

    /// KL(self ‖ other) `[B]` in nats, with the gradient in both: of categorical distributions Σ_j p_j (log p_j - log q_j), of
    /// Gaussians Σ_i (log σ_q - log σ_p + (σ_p² + (μ_p - μ_q)²)/(2 σ_q²) - ½).
    pub fn divergence_to(&self, other: &Distributions) -> Tensor {
        let sum = |terms: Tensor| terms.sum_dim_intlist(Some([-1i64].as_slice()), false, Kind::Float);
        match (&self.log_std, &other.log_std) {
            (Some(own), Some(others)) => {
                let distances = (&self.outputs - &other.outputs).square();
                let variances = (own * 2.0).exp();
                sum((distances + variances) * (others * -2.0).exp() * 0.5 + others - own - 0.5)
            }
            _ => {
                let log_probs = self.outputs.log_softmax(-1, Kind::Float);
                let others = other.outputs.log_softmax(-1, Kind::Float);
                sum(log_probs.exp() * (log_probs - others))
            }
        }
    }
}

/// Log-probabilities `[B]` of `actions` `[B, 1]` and entropies `[B]` of the categorical distributions of `logits` [B, n].
pub(super) fn categorical(logits: &Tensor, actions: &Tensor) -> (Tensor, Tensor) {
    let log_probs = logits.log_softmax(-1, Kind::Float);
    let chosen = log_probs.gather(1, &actions.to_kind(Kind::Int64), false).squeeze_dim(1);
    let entropy = -(log_probs.exp() * &log_probs).sum_dim_intlist(Some([-1i64].as_slice()), false, Kind::Float);
    (chosen, entropy)
}

/// Log-densities `[B]` of `actions` `[B, A]` and differential entropies `[B]` of the Gaussians of `means` `[B, A]` and
/// `log_std` `[A]`.
pub(super) fn gaussian(means: &Tensor, log_std: &Tensor, actions: &Tensor) -> (Tensor, Tensor) {
    let (batch, size) = (means.size()[0], means.size()[1] as f64);
    let distances = (actions - means) * (-log_std).exp();
    let sum_log_std = log_std.sum(Kind::Float);
    let squares = distances.square().sum_dim_intlist(Some([-1i64].as_slice()), false, Kind::Float);
    let log_probs = squares * -0.5 - (&sum_log_std + 0.5 * size * LOG_TAU);
    let entropy = (sum_log_std + 0.5 * size * (1.0 + LOG_TAU)).expand([batch].as_slice(), false);
    (log_probs, entropy)
}

/// Draws from the categorical distribution of `logits` by inverting the cumulative sum; one uniform number a draw.
/// Gives the choice and its log-probability.
pub(super) fn sample_categorical(logits: &[f32], rng: &mut ChaCha8Rng) -> (usize, f32) {
    let greatest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let total: f32 = logits.iter().map(|logit| (logit - greatest).exp()).sum();
    let target = uniform(rng) * f64::from(total);
    let mut choice = logits.len() - 1; // where rounding leaves target at the total
    let mut sum = 0.0f32;
    for (j, logit) in logits.iter().enumerate() {
        sum += (logit - greatest).exp();
        if f64::from(sum) > target {
            choice = j;
            break;
        }
    }
    (choice, logits[choice] - greatest - total.ln())
}

/// Draws an action `[A]` from the Gaussian of `means` `[A]` and `log_std` `[A]` into `action`; two uniform numbers an
/// element. Gives the log-density.
pub(super) fn sample_gaussian(means: &[f32], log_std: &[f32], rng: &mut ChaCha8Rng, action: &mut [f32]) -> f32 {
    let mut log_prob = -0.5 * LOG_TAU as f32 * means.len() as f32;
    for ((action, mean), log_std) in action.iter_mut().zip(means).zip(log_std) {
        let noise = normal(rng) as f32;
        *action = mean + log_std.exp() * noise;
        log_prob -= 0.5 * noise * noise + log_std;
    }
    log_prob
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{assert_close, fixture, tensor};
    use perturb_study::random::{Purpose, stream};

    /// Of results around 10 in f32, from up to ten roundings of 2⁻²⁴ each.
    const TOLERANCE: f64 = 5e-6;

    #[test]
    fn categorical_agrees_with_numpy() {
        let logits = tensor("categorical", "logits").view((11, 4));
        let actions = tensor("categorical", "actions").view((11, 1));
        let (log_probs, entropy) = categorical(&logits, &actions);
        assert_close(&log_probs, &fixture("categorical", "log_probs"), TOLERANCE);
        assert_close(&entropy, &fixture("categorical", "entropy"), TOLERANCE);
    }

    #[test]
    fn gaussian_agrees_with_numpy() {
        let matrix = |name| tensor("gaussian", name).view((11, 3));
        let (log_probs, entropy) = gaussian(&matrix("means"), &tensor("gaussian", "log_std"), &matrix("actions"));
        assert_close(&log_probs, &fixture("gaussian", "log_probs"), TOLERANCE);
        assert_close(&entropy, &fixture("gaussian", "entropy"), TOLERANCE);
    }

    #[test]
    fn divergences_agree_with_numpy_and_are_0_between_equals() {
        let categorical = |name| {
            let outputs = tensor("divergence_categorical", name).view((11, 4));
            Distributions { outputs, log_std: None }
        };
        let gaussian = |means, log_std| {
            let outputs = tensor("divergence_gaussian", means).view((11, 3));
            Distributions { outputs, log_std: Some(tensor("divergence_gaussian", log_std)) }
        };
        for (case, own, other) in [
            ("divergence_categorical", categorical("logits"), categorical("others")),
            ("divergence_gaussian", gaussian("means", "log_std"), gaussian("other_means", "other_log_std")),
        ] {
            assert_close(&own.divergence_to(&other), &fixture(case, "divergence"), TOLERANCE);
            // Of Gaussians σ² · σ⁻² is 1 but for two roundings of 2⁻²⁴ in each of three elements.
            assert_close(&own.divergence_to(&own), &[0.0; 11], 5e-7);
        }
    }

    #[test]
    fn choices_are_as_frequent_as_their_probabilities() {
        let logits = [0.3f32, -1.2, 1.1];
        let total: f64 = logits.iter().map(|&l| f64::from(l).exp()).sum();
        let mut rng = stream(5, Purpose::Actions);
        let (mut counts, draws) = ([0u32; 3], 100_000);
        for _ in 0..draws {
            let (choice, log_prob) = sample_categorical(&logits, &mut rng);
            counts[choice] += 1;
            let expected = f64::from(logits[choice]) - total.ln();
            assert!((f64::from(log_prob) - expected).abs() < 1e-6, "f32 rounding of numbers up to 4");
        }
        for (count, &logit) in counts.iter().zip(&logits) {
            let p = f64::from(logit).exp() / total;
            // Four standard deviations of a binomial share; the seed is fixed.
            let tolerance = 4.0 * (p * (1.0 - p) / f64::from(draws)).sqrt();
            assert!((f64::from(*count) / f64::from(draws) - p).abs() < tolerance, "{counts:?}");
        }
    }

    #[test]
    fn samples_have_the_mean_and_deviation_of_their_gaussian() {
        let (means, log_std) = ([0.5f32, -2.0], [0.3f32, -1.0]);
        let mut rng = stream(6, Purpose::Actions);
        let (draws, mut sums, mut squares, mut product) = (100_000, [0.0; 2], [0.0; 2], 0.0);
        for _ in 0..draws {
            let mut action = [0.0; 2];
            sample_gaussian(&means, &log_std, &mut rng, &mut action);
            let z: [f64; 2] = std::array::from_fn(|i| f64::from(action[i] - means[i]) / f64::from(log_std[i]).exp());
            for i in 0..2 {
                sums[i] += z[i] / f64::from(draws);
                squares[i] += z[i] * z[i] / f64::from(draws);
            }
            product += z[0] * z[1] / f64::from(draws);
        }
        // Four standard errors: 1/√draws of a mean and a covariance, √2/√draws of a variance.
        for i in 0..2 {
            assert!(sums[i].abs() < 0.0127 && (squares[i] - 1.0).abs() < 0.018, "{sums:?} {squares:?}");
        }
        assert!(product.abs() < 0.0127, "{product}");
    }
}
