//! Returns and advantages.

/// T steps of N environments, arrays in row-major [T, N] order.
#[derive(Clone, Copy, Debug)]
pub struct Trajectories<'a> {
    /// N.
    pub n_envs: usize,
    /// [T, N] rewards r_t.
    pub rewards: &'a [f32],
    /// [T, N] values V(s_t).
    pub values: &'a [f32],
    /// [T, N] whether the task ended the episode in step t.
    pub terminated: &'a [bool],
    /// [T, N] whether the time limit did.
    pub truncated: &'a [bool],
    /// [T, N] V(final observation) where truncated.
    pub truncation_values: &'a [f32],
    /// [N] V(s_T).
    pub last_values: &'a [f32],
}

/// Advantages and value targets.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimates {
    /// [T, N].
    pub advantages: Vec<f32>,
    /// [T, N].
    pub returns: Vec<f32>,
}

/// Generalised advantage estimation.
pub fn gae(_trajectories: &Trajectories<'_>, _gamma: f64, _gae_lambda: f64, _bootstrap_truncation: bool) -> Estimates {
    todo!()
}

/// n-step returns.
pub fn n_step_returns(_trajectories: &Trajectories<'_>, _gamma: f64, _bootstrap_truncation: bool) -> Estimates {
    todo!()
}
