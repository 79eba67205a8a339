//! The loss that an update minimises, and its derivatives with respect to a policy's outputs.

use crate::losses::Losses;
use crate::math::{exp, ln};
use crate::sample::{LOG_TAU, greatest_and_total};
use crate::spec::ActionKind;

/// The policy's term in a loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Surrogate {
    /// The policy-gradient loss of A2C: -1/B Σ_b advantage_b log π(a_b | s_b). Mnih et al. (2016), arXiv:1602.01783.
    PolicyGradient,
    /// The negated clipped surrogate of PPO, Schulman et al. (2017), arXiv:1707.06347, equation 7. With the probability
    /// ratio ρ_b = π(a_b | s_b)/π_old(a_b | s_b) it is
    ///
    /// 1/B Σ_b max(-advantage_b ρ_b, -advantage_b clip(ρ_b, 1 - range, 1 + range)).
    Clipped {
        /// Half of the width of the interval around 1 to which ratios are clipped.
        range: f64,
    },
}

/// The loss over B samples: surrogate - `ent_coef` · mean entropy + `vf_coef` · value loss + `kl_coef` · mean KL(π_old
/// ‖ π).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Objective {
    /// The policy's term.
    pub surrogate: Surrogate,
    /// Whether advantages are first normalised to mean 0 and standard deviation 1: (advantage_b - mean)/(standard
    /// deviation + 10⁻⁸). The standard deviation is that of the population (divided by B), as in OpenAI Baselines;
    /// stable-baselines3 divides by B - 1. A single advantage becomes 0.
    pub normalize_advantages: bool,
    /// Weight of the entropy, which is in nats.
    pub ent_coef: f64,
    /// Weight of the value loss.
    pub vf_coef: f64,
    /// Range for clipping the change of a value V_b from the rollout's value old_b, in units of the normalised rewards.
    /// The value loss is then 1/B Σ_b max((V_b - R_b)², (V_b' - R_b)²) with V_b' = old_b + clip(V_b - old_b, -range,
    /// range). This clipping is not in the PPO paper, but in OpenAI Baselines.
    ///
    /// `None` turns clipping off: the value loss is 1/B Σ_b (V_b - R_b)², without the factor ½ that some versions of
    /// Baselines have.
    pub value_clip_range: Option<f64>,
    /// Weight of the KL divergence from the acting policy, which is in nats.
    pub kl_coef: f64,
}

/// The action distributions of the policy that acted, for B samples.
#[derive(Clone, Copy, Debug)]
pub struct Acting<'a> {
    /// `[B, n]` logits, or `[B, A]` means.
    pub outputs: &'a [f32],
    /// `[A]` log standard deviations of continuous actions.
    pub log_std: &'a [f32],
}

/// A sample of a rollout, with the data that its loss needs.
pub(crate) struct Sample<'a> {
    pub(crate) action: &'a [f32],
    pub(crate) old_log_prob: f32,
    pub(crate) old_value: f32,
    /// The advantage; normalised if `normalize_advantages` is set.
    pub(crate) advantage: f32,
    pub(crate) return_: f32,
    /// The acting policy's logits or means, and its log standard deviations.
    pub(crate) acting: Option<(&'a [f32], &'a [f32])>,
}

/// The standard deviations of continuous actions, which do not depend on the observation. Empty for discrete actions.
#[derive(Clone, Debug)]
pub(crate) struct Gaussian {
    /// `[A]` log σ.
    pub(crate) log_std: Vec<f32>,
    /// `[A]` 1/σ.
    inverse_std: Vec<f32>,
}

impl Gaussian {
    pub(crate) fn new(size: usize) -> Self {
        Gaussian { log_std: vec![0.0; size], inverse_std: vec![1.0; size] }
    }

    pub(crate) fn load(&mut self, log_std: &[f32]) {
        self.log_std.copy_from_slice(log_std);
        self.inverse_std.iter_mut().zip(log_std).for_each(|(inverse, log_std)| *inverse = exp(-log_std));
    }
}

/// The outputs of the policy for one sample, and buffers for the loss's derivatives with respect to these outputs.
pub(crate) struct Outputs<'a> {
    /// `[n]` logits, or `[A]` means.
    pub(crate) head: &'a [f32],
    pub(crate) gaussian: &'a Gaussian,
    pub(crate) value: f32,
    /// Derivatives with respect to `head`; the buffer is overwritten.
    pub(crate) by_head: &'a mut [f32],
    /// `[A]` derivatives with respect to log σ; this sample's derivatives are added to the buffer.
    pub(crate) by_log_std: &'a mut [f32],
    /// The derivative with respect to `value`; the buffer is overwritten.
    pub(crate) by_value: &'a mut f32,
}

impl Objective {
    /// Divides the `sums` of the losses of `n` samples by `n`, and computes the total loss from these means.
    pub(crate) fn means(&self, sums: Losses, n: usize) -> Losses {
        let mut means = sums;
        let parts = [
            &mut means.policy,
            &mut means.value,
            &mut means.entropy,
            &mut means.approx_kl,
            &mut means.clip_fraction,
            &mut means.kl_divergence,
        ];
        parts.into_iter().for_each(|sum| *sum /= n as f64);
        let Objective { ent_coef, vf_coef, kl_coef, .. } = self;
        means.total = means.policy - ent_coef * means.entropy + vf_coef * means.value + kl_coef * means.kl_divergence;
        means
    }

    /// Computes the losses of one sample, and their derivatives with respect to the policy's outputs. The derivatives
    /// are divided by `n`, the number of samples in the minibatch; the losses are not.
    #[inline(always)]
    pub(crate) fn differentiate(
        &self,
        kind: ActionKind,
        sample: &Sample<'_>,
        outputs: Outputs<'_>,
        n: usize,
    ) -> Losses {
        let share = 1.0 / n as f32;
        let Outputs { head, gaussian, value, by_head, by_log_std, by_value } = outputs;
        let (value_loss, by) = self.value_loss(value, sample);
        *by_value = share * self.vf_coef as f32 * by;
        let by_entropy = -share * self.ent_coef as f32;
        let by_divergence = share * self.kl_coef as f32;
        let mut losses = Losses { value: f64::from(value_loss), ..Losses::default() };
        match kind {
            ActionKind::Discrete { .. } => {
                // The log-probability of the chosen action, and the surrogate's derivative with respect to it.
                let (greatest, total) = greatest_and_total(head);
                let log_total = ln(total);
                let log_prob = |logit: f32| logit - greatest - log_total;
                let chosen = sample.action[0] as usize;
                let by_log_prob = share * self.policy_loss(log_prob(head[chosen]), sample, &mut losses);
                // `by_head` first holds the probabilities, then the derivatives of surrogate and entropy.
                by_head.iter_mut().zip(head).for_each(|(p, &logit)| *p = exp(log_prob(logit)));
                let entropy = -by_head.iter().zip(head).map(|(p, &logit)| p * log_prob(logit)).sum::<f32>();
                losses.entropy = f64::from(entropy);
                for (j, (by, &logit)) in by_head.iter_mut().zip(head).enumerate() {
                    let p = *by;
                    let hit = if j == chosen { 1.0 } else { 0.0 };
                    *by = by_log_prob * (hit - p) - by_entropy * p * (log_prob(logit) + entropy);
                }
                // KL divergence from the acting policy, with its derivatives.
                if let Some((acting, _)) = sample.acting {
                    let (greatest, total) = greatest_and_total(acting);
                    let log_total = ln(total);
                    for ((by, &logit), &acting) in by_head.iter_mut().zip(head).zip(acting) {
                        let old = acting - greatest - log_total;
                        losses.kl_divergence += f64::from(exp(old) * (old - log_prob(logit)));
                        *by += by_divergence * (exp(log_prob(logit)) - exp(old));
                    }
                }
            }
            ActionKind::Continuous { .. } => {
                // Log-density and entropy of the Gaussian.
                let size = head.len() as f32;
                let mut log_prob = -0.5 * LOG_TAU * size;
                let mut entropy = 0.5 * (1.0 + LOG_TAU) * size;
                let Gaussian { log_std, inverse_std } = gaussian;
                for (((action, mean), log_std), scale) in sample.action.iter().zip(head).zip(log_std).zip(inverse_std) {
                    let distance = (action - mean) * scale;
                    log_prob -= 0.5 * distance * distance + log_std;
                    entropy += log_std;
                }
                let by_log_prob = share * self.policy_loss(log_prob, sample, &mut losses);
                losses.entropy = f64::from(entropy);
                // Derivatives with respect to each mean and log standard deviation.
                for i in 0..head.len() {
                    let action = sample.action[i];
                    let mean = head[i];
                    let log_std = log_std[i];
                    let scale = inverse_std[i];
                    let by_mean = &mut by_head[i];
                    let by_log_std = &mut by_log_std[i];
                    let distance = (action - mean) * scale;
                    *by_mean = by_log_prob * distance * scale;
                    *by_log_std += by_log_prob * (distance * distance - 1.0) + by_entropy;
                    if let Some((means, log_stds)) = sample.acting {
                        let shift = (means[i] - mean) * scale;
                        let old = exp(log_stds[i] - log_std);
                        let spread = old * old + shift * shift;
                        losses.kl_divergence += f64::from(log_std - log_stds[i] + 0.5 * spread - 0.5);
                        *by_mean -= by_divergence * shift * scale;
                        *by_log_std += by_divergence * (1.0 - spread);
                    }
                }
            }
        }
        losses
    }

    /// Returns the value loss of a sample, and its derivative with respect to the value.
    #[inline(always)]
    fn value_loss(&self, value: f32, sample: &Sample<'_>) -> (f32, f32) {
        let error = value - sample.return_;
        let free = (error * error, 2.0 * error);
        let Some(range) = self.value_clip_range else { return free };
        let moved = value - sample.old_value;
        let error = sample.old_value + moved.clamp(-range as f32, range as f32) - sample.return_;
        let clipped = error * error;
        // If V moved by at most `range`, it is not clipped, and both losses are equal up to rounding. The derivative is
        // then that of `free`.
        if free.0 >= clipped || moved.abs() <= range as f32 { free } else { (clipped, 0.0) }
    }

    /// Returns the derivative of a sample's surrogate with respect to its log-probability. Stores the surrogate,
    /// `approx_kl` and `clip_fraction` in `losses`.
    #[inline(always)]
    fn policy_loss(&self, log_prob: f32, sample: &Sample<'_>, losses: &mut Losses) -> f32 {
        let Surrogate::Clipped { range } = self.surrogate else {
            losses.policy = f64::from(-sample.advantage * log_prob);
            return -sample.advantage;
        };
        let log_ratio = log_prob - sample.old_log_prob;
        let ratio = exp(log_ratio);
        let free = -sample.advantage * ratio;
        let clipped = -sample.advantage * ratio.clamp((1.0 - range) as f32, (1.0 + range) as f32);
        losses.approx_kl = f64::from(ratio - 1.0 - log_ratio);
        losses.clip_fraction = f64::from(u8::from((ratio - 1.0).abs() > range as f32));
        // If the ratio is within 1 ± `range`, both losses are equal. Comparisons with NaN are false, so a NaN in `free`
        // is passed on.
        let (loss, derivative) = if clipped > free { (clipped, 0.0) } else { (free, free) };
        losses.policy = f64::from(loss);
        derivative
    }
}
