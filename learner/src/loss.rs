//! Losses, as pure functions. Tensors are f32 `[B]` over the samples of a batch, b = 0 … B-1; results have no axes.

use tch::{Kind, Tensor};

/// Added to the standard deviation that advantages are divided by.
const EPSILON: f64 = 1e-8;

/// What PPO minimises of the policy, and how far the policy has moved.
#[derive(Debug)]
pub struct ClippedSurrogate {
    /// The loss.
    pub loss: Tensor,
    /// Estimate of the KL divergence of the new from the old policy, in nats; without gradient.
    pub approx_kl: Tensor,
    /// Share of samples whose ratio is outside 1 ± `clip_range`; without gradient.
    pub clip_fraction: Tensor,
}

/// The policy gradient's loss: -1/B Σ_b advantage_b log π(a_b | s_b). Mnih et al. (2016), arXiv:1602.01783.
pub fn policy_gradient(log_probs: &Tensor, advantages: &Tensor) -> Tensor {
    -(log_probs * advantages).mean(Kind::Float)
}

/// PPO's clipped surrogate, Schulman et al. (2017), arXiv:1707.06347, equation 7, negated: with the ratio
/// ρ_b = π(a_b | s_b)/π_old(a_b | s_b),
///
/// loss = 1/B Σ_b max(-advantage_b ρ_b, -advantage_b clip(ρ_b, 1 - clip_range, 1 + clip_range)).
///
/// `approx_kl` is 1/B Σ_b (ρ_b - 1 - log ρ_b), which is never negative (as stable-baselines3; the reference logs
/// 1/B Σ_b ½ log² ρ_b, which is the same to second order).
pub fn clipped_surrogate(
    log_probs: &Tensor,
    old_log_probs: &Tensor,
    advantages: &Tensor,
    clip_range: f64,
) -> ClippedSurrogate {
    let log_ratio = log_probs - old_log_probs;
    let ratio = log_ratio.exp();
    let against = -advantages;
    let free = &against * &ratio;
    let clipped = against * ratio.clamp(1.0 - clip_range, 1.0 + clip_range);
    let (log_ratio, ratio) = (log_ratio.detach(), ratio.detach() - 1.0);
    ClippedSurrogate {
        loss: free.maximum(&clipped).mean(Kind::Float),
        clip_fraction: ratio.abs().gt(clip_range).to_kind(Kind::Float).mean(Kind::Float),
        approx_kl: (ratio - log_ratio).mean(Kind::Float),
    }
}

/// The value loss: 1/B Σ_b (V(s_b) - return_b)², without the further ½ of some versions of the reference.
pub fn value(values: &Tensor, returns: &Tensor) -> Tensor {
    (values - returns).square().mean(Kind::Float)
}

/// The value loss of which no sample's V gains by moving farther than `clip_range` from the rollout's value:
/// 1/B Σ_b max((V_b - R_b)², (V_b' - R_b)²), V_b' = old_b + clip(V_b - old_b, -clip_range, clip_range).
///
/// Not in the paper on PPO, but in the reference. Its unit is that of the normalised rewards.
pub fn clipped_value(values: &Tensor, old_values: &Tensor, returns: &Tensor, clip_range: f64) -> Tensor {
    let clipped = old_values + (values - old_values).clamp(-clip_range, clip_range);
    (values - returns).square().maximum(&(clipped - returns).square()).mean(Kind::Float)
}

/// (advantage_b - mean)/(standard deviation + 10⁻⁸), with the population's standard deviation as in the reference
/// (stable-baselines3: the sample's). A single advantage becomes 0.
pub fn normalize_advantages(advantages: &Tensor) -> Tensor {
    (advantages - advantages.mean(Kind::Float)) / (advantages.std(false) + EPSILON)
}

/// 1 - Var(return - value)/Var(return) over all samples: 1 = values are perfect, 0 = no better than a constant, below
/// 0 = worse. None if the returns are constant, for which it is not defined.
pub fn explained_variance(values: &[f32], returns: &[f32]) -> Option<f64> {
    let variance = |numbers: &mut dyn Iterator<Item = f64>| {
        let numbers: Vec<f64> = numbers.collect();
        let mean = numbers.iter().sum::<f64>() / numbers.len() as f64;
        numbers.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / numbers.len() as f64
    };
    let total = variance(&mut returns.iter().map(|&x| f64::from(x)));
    let left = variance(&mut returns.iter().zip(values).map(|(&r, &v)| f64::from(r) - f64::from(v)));
    (total > 0.0).then(|| 1.0 - left / total)
}
