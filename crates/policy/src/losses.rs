//! The terms of a loss.

/// The terms of a loss, as means over samples.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// The policy's term, see [`Surrogate`](crate::Surrogate).
    pub policy: f64,
    /// The value loss, not multiplied by `vf_coef`.
    pub value: f64,
    /// Entropy of the action distributions, in nats.
    pub entropy: f64,
    /// The total loss, which an update minimises.
    pub total: f64,
    /// Estimate of the KL divergence of the new policy from the acting policy, in nats: 1/B Σ_b (ρ_b - 1 - log ρ_b), as
    /// in stable-baselines3. It is never negative, apart from rounding. OpenAI Baselines logs 1/B Σ_b ½ log² ρ_b, which
    /// is equal to second order. 0 for losses without probability ratios.
    pub approx_kl: f64,
    /// Share of samples, 0 … 1, whose probability ratio is outside of 1 ± [`range`](crate::Surrogate::Clipped). 0 for
    /// losses without probability ratios.
    pub clip_fraction: f64,
    /// KL(π_old ‖ π), in nats, computed from the distributions. 0 if the distributions of the acting policy are not
    /// given.
    pub kl_divergence: f64,
}

impl std::ops::AddAssign for Losses {
    fn add_assign(&mut self, other: Losses) {
        self.policy += other.policy;
        self.value += other.value;
        self.entropy += other.entropy;
        self.total += other.total;
        self.approx_kl += other.approx_kl;
        self.clip_fraction += other.clip_fraction;
        self.kl_divergence += other.kl_divergence;
    }
}
