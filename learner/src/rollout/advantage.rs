//! Returns and advantages, as pure functions over arrays.
//!
//! Both estimators treat the end of an episode alike. Let V' be what is expected after step t, t = 0 … T-1:
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
    /// `[T, N]` whether the time limit did.
    pub truncated: &'a [bool],
    /// `[T, N]` V(final observation) where truncated; ignored elsewhere.
    pub truncation_values: &'a [f32],
    /// `[N]` V(s_T); ignored where step T-1 ended an episode.
    pub last_values: &'a [f32],
}

/// Advantages and value targets.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimates {
    /// `[T, N]` how much better the action was than expected.
    pub advantages: Vec<f32>,
    /// `[T, N]` what V(s_t) should have been.
    pub returns: Vec<f32>,
}

/// Generalised advantage estimation, Schulman et al. (2016), arXiv:1506.02438, equation 16: for t = T-1 … 0
///
/// δ_t = r_t + γ V' - V(s_t),
/// A_t = δ_t + γ λ c_t A_{t+1},
///
/// where c_t = 0 if step t ended an episode, else 1, and A_T = 0. The returns are A_t + V(s_t).
///
/// # Panics
///
/// If arrays have different lengths.
pub fn gae(trajectories: &Trajectories<'_>, gamma: f64, gae_lambda: f64, bootstrap_truncation: bool) -> Estimates {
    backward(trajectories, bootstrap_truncation, |step| {
        let delta = step.reward + gamma * step.next_value - step.value;
        let advantage = if step.ended { delta } else { delta + gamma * gae_lambda * step.later.0 };
        (advantage, advantage + step.value)
    })
}

/// n-step returns, Mnih et al. (2016), arXiv:1602.01783, algorithm S3: for t = T-1 … 0
///
/// R_t = r_t + γ V' if step t ended an episode or t = T-1, else r_t + γ R_{t+1}.
///
/// Every return thus looks as far as the rollout or the episode goes. The advantages are R_t - V(s_t), which is [`gae`]
/// with λ = 1.
///
/// # Panics
///
/// If arrays have different lengths.
pub fn n_step_returns(trajectories: &Trajectories<'_>, gamma: f64, bootstrap_truncation: bool) -> Estimates {
    backward(trajectories, bootstrap_truncation, |step| {
        let next = if step.ended || step.last { step.next_value } else { step.later.1 };
        let target = step.reward + gamma * next;
        (target - step.value, target)
    })
}

/// What an estimator sees of step t of an environment.
struct Step {
    reward: f64,
    value: f64,
    /// V'.
    next_value: f64,
    /// Whether an episode ended.
    ended: bool,
    /// Whether t = T-1.
    last: bool,
    /// Advantage and return of step t+1; 0 for t = T-1.
    later: (f64, f64),
}

/// Walks every environment from its last step to its first; `estimate` gives a step's advantage and return.
fn backward(trajectories: &Trajectories<'_>, bootstrap: bool, estimate: impl Fn(Step) -> (f64, f64)) -> Estimates {
    let Trajectories { n_envs, rewards, values, terminated, truncated, truncation_values, last_values } = *trajectories;
    let size = rewards.len();
    let lengths = [values.len(), terminated.len(), truncated.len(), truncation_values.len()];
    assert!(lengths == [size; 4] && last_values.len() == n_envs, "arrays [T, N] have {size} and {lengths:?} elements");
    let mut estimates = Estimates { advantages: vec![0.0; size], returns: vec![0.0; size] };
    for (n, &last_value) in last_values.iter().enumerate() {
        let mut later = (0.0, 0.0);
        let mut later_value = f64::from(last_value);
        for i in (n..size).step_by(n_envs).rev() {
            let next_value = match (terminated[i], truncated[i]) {
                (true, _) => 0.0,
                (false, true) if bootstrap => f64::from(truncation_values[i]),
                (false, true) => 0.0,
                (false, false) => later_value,
            };
            let value = f64::from(values[i]);
            later = estimate(Step {
                reward: f64::from(rewards[i]),
                value,
                next_value,
                ended: terminated[i] || truncated[i],
                last: i + n_envs >= size,
                later,
            });
            later_value = value;
            estimates.advantages[i] = later.0 as f32;
            estimates.returns[i] = later.1 as f32;
        }
    }
    estimates
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
