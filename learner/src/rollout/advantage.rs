//! Returns and advantages: what their estimators have in common.
//!
//! PPO estimates advantages by [`gae`](crate::algorithm::gae), A2C returns by
//! [`n_step_returns`](crate::algorithm::n_step_returns). Both treat the end of an episode alike. Let V' be what is expected after step t, t = 0 … T-1:
//!
//! - terminated: V' = 0;
//! - else truncated: V' = V(final observation), or 0 without `bootstrap_truncation`;
//! - else V' = V(s_{t+1}), where V(s_T) is `last_values`.
//!
//! After a termination or a truncation the trace is cut: nothing of step t+1, which belongs to the next episode, flows
//! back. If both flags are set, termination wins. The reference treats a truncation as a termination, which is
//! `bootstrap_truncation = false`; why that biases values: Pardo et al. (2018), arXiv:1712.00378.
//!
//! With trials of several episodes (RL²) a trial is the episode that is meant here: its flags are those of the trial's
//! end.
//!
//! Sums are in f64 and rounded once, at the end.

/// T steps of N environments; arrays are row-major.
#[derive(Clone, Copy, Debug)]
pub struct Trajectories<'a> {
    /// N.
    pub n_envs: usize,
    /// `[T, N]` rewards r_t, received after the action at s_t.
    pub rewards: &'a [f32],
    /// `[T, N]` values V(s_t).
    pub values: &'a [f32],
    /// `[T, N]` whether the task ended the episode in step t.
    pub terminated: &'a [bool],
    /// `[T, N]` whether the time limit ended the episode in step t.
    pub truncated: &'a [bool],
    /// `[T, N]` V(final observation) where truncated; ignored elsewhere.
    pub truncation_values: &'a [f32],
    /// `[N]` V(s_T); ignored where step T-1 ended an episode.
    pub last_values: &'a [f32],
}

/// Step t of an environment, as an estimator sees it.
#[derive(Clone, Copy, Debug)]
pub struct EstimatorStep {
    /// r_t.
    pub reward: f64,
    /// V(s_t).
    pub value: f64,
    /// V'.
    pub next_value: f64,
    /// Whether step t ended an episode.
    pub ended: bool,
    /// Whether t = T-1.
    pub last: bool,
    /// The advantage of step t+1; 0 for t = T-1.
    pub next_advantage: f64,
    /// The return of step t+1; 0 for t = T-1.
    pub next_return: f64,
}

/// Advantages and value targets.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimates {
    /// `[T, N]` how much better the action was than expected.
    pub advantages: Vec<f32>,
    /// `[T, N]` what V(s_t) should have been.
    pub returns: Vec<f32>,
}

impl Trajectories<'_> {
    /// Walks every environment from its last step to its first; `estimate` returns a step's advantage and return. Truncated
    /// episodes are bootstrapped if `bootstrap_truncation` is set.
    ///
    /// # Panics
    ///
    /// If arrays have different lengths.
    pub fn backward(&self, bootstrap_truncation: bool, estimate: impl Fn(EstimatorStep) -> (f64, f64)) -> Estimates {
        let Trajectories { n_envs, rewards, values, terminated, truncated, truncation_values, last_values } = *self;
        let size = rewards.len();
        let lengths = [values.len(), terminated.len(), truncated.len(), truncation_values.len()];
        assert!(
            lengths == [size; 4] && last_values.len() == n_envs,
            "arrays [T, N] have {size} and {lengths:?} elements"
        );
        let mut estimates = Estimates { advantages: vec![0.0; size], returns: vec![0.0; size] };
        for (n, &last_value) in last_values.iter().enumerate() {
            let mut next = (0.0, 0.0);
            let mut value_after = f64::from(last_value);
            for i in (n..size).step_by(n_envs).rev() {
                let next_value = match (terminated[i], truncated[i]) {
                    (true, _) => 0.0,
                    (false, true) if bootstrap_truncation => f64::from(truncation_values[i]),
                    (false, true) => 0.0,
                    (false, false) => value_after,
                };
                let value = f64::from(values[i]);
                next = estimate(EstimatorStep {
                    reward: f64::from(rewards[i]),
                    value,
                    next_value,
                    ended: terminated[i] || truncated[i],
                    last: i + n_envs >= size,
                    next_advantage: next.0,
                    next_return: next.1,
                });
                value_after = value;
                estimates.advantages[i] = next.0 as f32;
                estimates.returns[i] = next.1 as f32;
            }
        }
        estimates
    }
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
