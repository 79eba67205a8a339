//! The rollout buffer.

use super::advantage::Trajectories;
use crate::error::Result;

/// One step of N environments, as it is pushed.
#[derive(Clone, Copy, Debug)]
pub struct RolloutStep<'a> {
    /// [N, O] observations s_t that the actions were chosen on, normalised.
    pub observations: &'a [f32],
    /// [N, A] actions, as in [`Acts`](crate::policy::Acts).
    pub actions: &'a [f32],
    /// [N] log-probabilities of the actions under the acting policy.
    pub log_probs: &'a [f32],
    /// [N] V(s_t).
    pub values: &'a [f32],
    /// [N] rewards, normalised.
    pub rewards: &'a [f32],
    /// [N] whether the task ended the episode.
    pub terminated: &'a [bool],
    /// [N] whether the time limit ended it.
    pub truncated: &'a [bool],
    /// [N] V(final observation) where truncated; ignored elsewhere.
    pub truncation_values: &'a [f32],
}

/// T steps of N environments, arrays in row-major [T, N, …] order.
#[derive(Clone, Debug)]
pub struct Rollout {}

impl Rollout {
    /// An empty rollout for T = `n_steps`, N = `n_envs`, O = `observation_size`, A = `action_width`.
    pub fn new(_n_steps: usize, _n_envs: usize, _observation_size: usize, _action_width: usize) -> Self {
        todo!()
    }
    /// Forgets all steps; keeps the memory.
    pub fn clear(&mut self) {
        todo!()
    }
    /// Steps pushed since the last `clear`.
    pub fn len(&self) -> usize {
        todo!()
    }
    /// Whether no step was pushed yet.
    pub fn is_empty(&self) -> bool {
        todo!()
    }
    /// Whether T steps were pushed.
    pub fn is_full(&self) -> bool {
        todo!()
    }
    /// Appends a step.
    pub fn push(&mut self, _step: RolloutStep<'_>) -> Result<()> {
        todo!()
    }
    /// Sets `last_values` [N] = V(s_T), after the last step and before an update.
    pub fn finish(&mut self, _last_values: &[f32]) -> Result<()> {
        todo!()
    }
    /// The view for advantage estimation.
    pub fn trajectories(&self) -> Result<Trajectories<'_>> {
        todo!()
    }
}
