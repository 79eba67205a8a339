//! The loss of an [`Objective`] on libtorch. Tensors are f32 `[B]` over the samples of a batch; results are scalars.

use perturb_policy::{Losses, Objective, Surrogate};
use tch::{Kind, Tensor};

use super::{Distributions, Evaluated};
use crate::error::Result;

/// Number that is added to the standard deviation of advantages before they are divided by it.
const EPSILON: f64 = 1e-8;

/// The inputs of a loss that do not depend on the policy being trained.
#[derive(Debug)]
pub struct LossTargets {
    /// Log-probabilities of the actions under the policy that acted.
    pub old_log_probs: Tensor,
    /// Values V that the policy computed when it acted.
    pub old_values: Tensor,
    /// The advantages.
    pub advantages: Tensor,
    /// Target values for V.
    pub returns: Tensor,
    /// The action distributions of the policy that acted, if the loss has a KL divergence.
    pub acting: Option<Distributions>,
}

/// Computes the loss of `objective`. Returns the total loss as a tensor, which is differentiable through `evaluated`,
/// and all terms of the loss.
pub fn evaluate(objective: &Objective, evaluated: &Evaluated, targets: &LossTargets) -> Result<(Tensor, Losses)> {
    let Objective { ent_coef, vf_coef, kl_coef, .. } = *objective;
    let normalised = objective.normalize_advantages.then(|| normalise(&targets.advantages));
    let advantages = normalised.as_ref().unwrap_or(&targets.advantages);
    let zero = targets.returns.zeros_like().mean(Kind::Float);
    let [policy, approx_kl, clip_fraction] = match objective.surrogate {
        Surrogate::PolicyGradient => {
            [-(&evaluated.log_probs * advantages).mean(Kind::Float), zero.shallow_clone(), zero.shallow_clone()]
        }
        Surrogate::Clipped { range } => clipped_surrogate(&evaluated.log_probs, targets, advantages, range),
    };
    let value = value_loss(&evaluated.values, targets, objective.value_clip_range);
    let entropy = evaluated.entropy.mean(Kind::Float);
    let divergence = match &targets.acting {
        Some(acting) => acting.divergence_to(&evaluated.distributions).mean(Kind::Float),
        None => zero,
    };
    let total = &policy - &entropy * ent_coef + &value * vf_coef + &divergence * kl_coef;
    let mut numbers = [0.0f32; 7];
    let losses = [&policy, &value, &entropy, &total, &approx_kl, &clip_fraction, &divergence];
    Tensor::f_stack(&losses, 0)?.f_copy_data(&mut numbers, losses.len())?;
    let [policy, value, entropy, sum, approx_kl, clip_fraction, kl_divergence] = numbers.map(f64::from);
    Ok((total, Losses { policy, value, entropy, total: sum, approx_kl, clip_fraction, kl_divergence }))
}

/// Returns PPO's clipped surrogate, the approximate KL divergence and the share of clipped samples. Only the surrogate
/// is differentiable.
fn clipped_surrogate(log_probs: &Tensor, targets: &LossTargets, advantages: &Tensor, range: f64) -> [Tensor; 3] {
    let log_ratio = log_probs - &targets.old_log_probs;
    let ratio = log_ratio.exp();
    let against = -advantages;
    let free = &against * &ratio;
    let clipped = against * ratio.clamp(1.0 - range, 1.0 + range);
    let log_ratio = log_ratio.detach();
    let ratio = ratio.detach() - 1.0;
    let outside = ratio.abs().gt(range).to_kind(Kind::Float);
    [free.maximum(&clipped), ratio - log_ratio, outside].map(|terms| terms.mean(Kind::Float))
}

fn value_loss(values: &Tensor, targets: &LossTargets, clip_range: Option<f64>) -> Tensor {
    let LossTargets { old_values, returns, .. } = targets;
    let free = (values - returns).square();
    let Some(range) = clip_range else { return free.mean(Kind::Float) };
    let clipped = old_values + (values - old_values).clamp(-range, range);
    free.maximum(&(clipped - returns).square()).mean(Kind::Float)
}

fn normalise(advantages: &Tensor) -> Tensor {
    (advantages - advantages.mean(Kind::Float)) / (advantages.std(false) + EPSILON)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{assert_close, fixture, tensor};

    /// Tolerance for results of about 1 in f32: means over 11 samples have about ten roundings of 2⁻²⁴.
    const TOLERANCE: f64 = 2e-6;

    fn targets() -> LossTargets {
        let tensor = |name| tensor("losses", name);
        LossTargets {
            old_log_probs: tensor("old_log_probs"),
            old_values: tensor("old_values"),
            advantages: tensor("advantages"),
            returns: tensor("returns"),
            acting: None,
        }
    }

    #[test]
    fn losses_agree_with_numpy() {
        let log_probs = tensor("losses", "log_probs");
        let values = tensor("losses", "values");
        let targets = targets();
        let surrogate = clipped_surrogate(&log_probs, &targets, &targets.advantages, 0.2);
        for (got, name) in surrogate.iter().zip(["clipped_surrogate", "approx_kl", "clip_fraction"]) {
            assert_close(got, &fixture("losses", name), TOLERANCE);
        }
        assert_close(&value_loss(&values, &targets, None), &fixture("losses", "value"), TOLERANCE);
        assert_close(&value_loss(&values, &targets, Some(0.2)), &fixture("losses", "clipped_value"), TOLERANCE);
        assert_close(&normalise(&targets.advantages), &fixture("losses", "normalized"), TOLERANCE);
    }

    #[test]
    fn the_surrogate_has_no_gradient_where_moving_on_would_gain() {
        // The ratios are 1.5 and 0.5. The ratio 1.5 is clipped if the advantage is positive, the ratio 0.5 if it is
        // negative.
        let advantages = Tensor::of_slice(&[1.0f32, -1.0, 1.0, -1.0]);
        let targets = LossTargets { old_log_probs: Tensor::of_slice(&[0.0f32; 4]), ..targets() };
        let log_probs = [1.5f32.ln(), 1.5f32.ln(), 0.5f32.ln(), 0.5f32.ln()];
        let log_probs = Tensor::of_slice(&log_probs).set_requires_grad(true);
        let [loss, _, clip_fraction] = clipped_surrogate(&log_probs, &targets, &advantages, 0.2);
        loss.backward();
        // The derivative of -A ρ with respect to log π is -A ρ, divided by 4 samples.
        assert_close(&log_probs.grad(), &[0.0, 1.5 / 4.0, -0.5 / 4.0, 0.0], 1e-7);
        assert_eq!(clip_fraction.double_value(&[]), 1.0);
    }

    #[test]
    fn normalised_advantages_of_a_single_sample_are_0() {
        assert_close(&normalise(&Tensor::of_slice(&[3.0f32])), &[0.0], f64::MIN_POSITIVE);
    }
}
