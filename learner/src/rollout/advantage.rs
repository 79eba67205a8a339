//! The common part of the estimators of returns and advantages: how they handle the ends of episodes.
//!
//! PPO estimates advantages by [`gae`](crate::algorithm::gae), and A2C estimates returns by
//! [`n_step_returns`](crate::algorithm::n_step_returns). Both handle the end of an episode in the same way. Let V' be
//! the expected return after step t, t = 0 … T-1:
//!
//! - terminated: V' = 0;
//! - otherwise, truncated: V' = V(final observation), or 0 without `bootstrap_truncation`;
//! - otherwise: V' = V(s_{t+1}), where V(s_T) is in `last_values`.
//!
//! If step t ends an episode, the estimates of step t do not depend on step t+1, which belongs to the next episode. If
//! both flags are set, termination takes precedence. `bootstrap_truncation = false` treats a truncation as a
//! termination, as the paper's published code does. Pardo et al. (2018), arXiv:1712.00378, explain why this biases
//! values.
//!
//! With RL², a whole trial of several episodes takes the place of an episode here: the flags mark the end of a trial.
//!
//! Sums are computed in f64, and rounded to f32 once, at the end.

/// The input of the estimators: T steps of N environments. Arrays are row-major.
#[derive(Clone, Copy, Debug)]
pub struct Trajectories<'a> {
    /// N, the number of environments.
    pub n_envs: usize,
    /// Rewards r_t `[T, N]`, received after the action in state s_t.
    pub rewards: &'a [f32],
    /// Values V(s_t) `[T, N]`.
    pub values: &'a [f32],
    /// Whether the task ended the episode in step t, `[T, N]`.
    pub terminated: &'a [bool],
    /// Whether the step limit ended the episode in step t, `[T, N]`.
    pub truncated: &'a [bool],
    /// V(final observation) of truncated episodes, `[T, N]`; ignored for other steps.
    pub truncation_values: &'a [f32],
    /// V(s_T) `[N]`; ignored if step T-1 ended an episode.
    pub last_values: &'a [f32],
}

/// Step t of an environment: the input of an estimator.
#[derive(Clone, Copy, Debug)]
pub struct EstimatorStep {
    /// The reward r_t.
    pub reward: f64,
    /// The value V(s_t).
    pub value: f64,
    /// The value V' of the observation after the step, see the module's description.
    pub next_value: f64,
    /// Whether step t ended an episode.
    pub ended: bool,
    /// Whether this is the last step of the rollout: t = T-1.
    pub last: bool,
    /// The advantage of step t+1; 0 for t = T-1.
    pub next_advantage: f64,
    /// The return of step t+1; 0 for t = T-1.
    pub next_return: f64,
}

/// The output of an estimator: advantages and returns.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimates {
    /// Advantages `[T, N]`: estimates of how much better an action was than the policy's average action.
    pub advantages: Vec<f32>,
    /// Returns `[T, N]`: the targets of the value function at s_t.
    pub returns: Vec<f32>,
}

impl Trajectories<'_> {
    /// Calls `estimate` for the steps of every environment, from the last to the first. `estimate` returns the
    /// advantage and the return of the step. `bootstrap_truncation` decides about V' after truncated episodes, see the
    /// module's description.
    ///
    /// # Panics
    ///
    /// Panics if arrays have different lengths.
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

/// Returns the share of the variance of the returns that the values explain: 1 - Var(return - value) / Var(return) over
/// all samples. 1 means perfect values, 0 no better than a constant, and negative numbers worse than a constant.
/// Returns `None` if the returns are constant.
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
