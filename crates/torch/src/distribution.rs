//! The two kinds of action distributions, on tensors:
//!
//! - Categorical distribution with logits l_j, j = 0 … n-1: log π(a) = l_a - log Σ_j exp l_j.
//! - Diagonal Gaussian with means μ_i and log standard deviations log σ_i, i = 0 … A-1: log π(a) = -½ Σ_i ((a_i -
//!   μ_i)/σ_i)² - Σ_i log σ_i - ½ A log 2π.

use tch::{Kind, Tensor};

use crate::error::Result;

/// log 2π.
const LOG_TAU: f64 = 1.837_877_066_409_345_3;

/// Action distributions, one for each of B samples.
#[derive(Debug)]
pub struct Distributions {
    /// `[B, n]` logits, or `[B, A]` means. Several axes may take the place of B.
    pub(super) outputs: Tensor,
    /// `[A]` log standard deviations of continuous actions.
    pub(super) log_std: Option<Tensor>,
}

impl Distributions {
    /// Returns distributions with the same log standard deviations, and with outputs changed by `change`.
    pub(crate) fn map(&self, change: impl FnOnce(&Tensor) -> Result<Tensor>) -> Result<Self> {
        Ok(Distributions { outputs: change(&self.outputs)?, log_std: self.log_std.as_ref().map(Tensor::shallow_clone) })
    }

    /// Creates distributions of the same kind. `outputs` are the logits `[B, n]` or means `[B, A]` as one array, and
    /// `log_std` the log standard deviations.
    pub fn with(&self, outputs: &[f32], log_std: &[f32]) -> Self {
        let width = self.outputs.size().last().copied().unwrap_or(1);
        Distributions {
            outputs: Tensor::of_slice(outputs).view((-1, width)),
            log_std: self.log_std.as_ref().map(|_| Tensor::of_slice(log_std)),
        }
    }

    /// Returns KL(self ‖ other) `[B]` in nats, differentiable in both. For categorical distributions it is Σ_j p_j (log
    /// p_j - log q_j), for Gaussians Σ_i (log σ_q - log σ_p + (σ_p² + (μ_p - μ_q)²)/(2 σ_q²) - ½).
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

/// Returns the log-probabilities `[B]` of `actions` `[B, 1]` and the entropies `[B]`, for the categorical distributions
/// with `logits` `[B, n]`.
pub(super) fn categorical(logits: &Tensor, actions: &Tensor) -> (Tensor, Tensor) {
    let log_probs = logits.log_softmax(-1, Kind::Float);
    let chosen = log_probs.gather(1, &actions.to_kind(Kind::Int64), false).squeeze_dim(1);
    let entropy = -(log_probs.exp() * &log_probs).sum_dim_intlist(Some([-1i64].as_slice()), false, Kind::Float);
    (chosen, entropy)
}

/// Returns the log-densities `[B]` of `actions` `[B, A]` and the differential entropies `[B]`, for the Gaussians with
/// `means` `[B, A]` and log standard deviations `log_std` `[A]`.
pub(super) fn gaussian(means: &Tensor, log_std: &Tensor, actions: &Tensor) -> (Tensor, Tensor) {
    let batch = means.size()[0];
    let size = means.size()[1] as f64;
    let distances = (actions - means) * (-log_std).exp();
    let sum_log_std = log_std.sum(Kind::Float);
    let squares = distances.square().sum_dim_intlist(Some([-1i64].as_slice()), false, Kind::Float);
    let log_probs = squares * -0.5 - (&sum_log_std + 0.5 * size * LOG_TAU);
    let entropy = (sum_log_std + 0.5 * size * (1.0 + LOG_TAU)).expand([batch].as_slice(), false);
    (log_probs, entropy)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{assert_close, fixture, tensor};

    /// Tolerance for results of about 10 in f32, after up to ten roundings of 2⁻²⁴ each.
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
            // For Gaussians, σ² · σ⁻² is 1 up to two roundings of 2⁻²⁴ in each of three elements.
            assert_close(&own.divergence_to(&own), &[0.0; 11], 5e-7);
        }
    }
}
