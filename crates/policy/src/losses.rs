//! The parts of a loss.

/// The parts of a loss, as means over samples.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// The surrogate.
    pub policy: f64,
    /// The value loss, before `vf_coef`.
    pub value: f64,
    /// Entropy of the action distributions, nats.
    pub entropy: f64,
    /// The sum that is minimised.
    pub total: f64,
    /// Estimate of the KL divergence of the new from the acting policy, in nats: 1/B Σ_b (ρ_b - 1 - log ρ_b), which is not
    /// negative but for rounding (as stable-baselines3; the reference logs 1/B Σ_b ½ log² ρ_b, which is the same to second order). 0 without
    /// ratios.
    pub approx_kl: f64,
    /// Share of samples whose ratio is outside 1 ± range; 0 without ratios.
    pub clip_fraction: f64,
    /// KL(π_old ‖ π), nats; 0 where the acting distributions are not given.
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
