//! The rollout buffer.

use super::advantage::Trajectories;
use crate::error::{Error, Result, check_length};

/// One step of N environments, as it is pushed.
#[derive(Clone, Copy, Debug)]
pub struct RolloutStep<'a> {
    /// `[N, O]` observations s_t that the actions were chosen on, normalised.
    pub observations: &'a [f32],
    /// `[N]` whether s_t is the first that the policy remembers: its memory was emptied before it.
    pub starts: &'a [bool],
    /// `[N, A]` actions, as in [`Acts`](crate::policy::Acts).
    pub actions: &'a [f32],
    /// `[N]` log-probabilities of the actions under the acting policy.
    pub log_probs: &'a [f32],
    /// `[N]` V(s_t).
    pub values: &'a [f32],
    /// `[N]` rewards r_t that the actions brought, normalised.
    pub rewards: &'a [f32],
    /// `[N]` whether the task ended the episode.
    pub terminated: &'a [bool],
    /// `[N]` whether the time limit ended it.
    pub truncated: &'a [bool],
    /// `[N]` V(final observation) where truncated; ignored elsewhere.
    pub truncation_values: &'a [f32],
}

/// T steps of N environments. Arrays are row-major [T, N, …], so that a step is pushed as one piece; flattened to
/// T·N samples, sample t·N + n is step t of environment n.
#[derive(Clone, Debug)]
pub struct Rollout {
    n_steps: usize,
    n_envs: usize,
    observation_size: usize,
    action_width: usize,
    len: usize,
    finished: bool,
    observations: Vec<f32>,
    starts: Vec<bool>,
    actions: Vec<f32>,
    log_probs: Vec<f32>,
    values: Vec<f32>,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    truncation_values: Vec<f32>,
    last_values: Vec<f32>,
    memory: Vec<f32>,
}

impl Rollout {
    /// An empty rollout for T = `n_steps`, N = `n_envs`, O = `observation_size` and A = `action_width` (see
    /// [`ActionKind::width`](crate::policy::ActionKind::width)). Allocates everything that it will need.
    pub fn new(n_steps: usize, n_envs: usize, observation_size: usize, action_width: usize) -> Self {
        let size = n_steps * n_envs;
        Rollout {
            n_steps,
            n_envs,
            observation_size,
            action_width,
            len: 0,
            finished: false,
            observations: Vec::with_capacity(size * observation_size),
            starts: Vec::with_capacity(size),
            actions: Vec::with_capacity(size * action_width),
            log_probs: Vec::with_capacity(size),
            values: Vec::with_capacity(size),
            rewards: Vec::with_capacity(size),
            terminated: Vec::with_capacity(size),
            truncated: Vec::with_capacity(size),
            truncation_values: Vec::with_capacity(size),
            last_values: Vec::with_capacity(n_envs),
            memory: Vec::new(),
        }
    }

    /// Forgets all steps, and takes over what the policy remembers before the first: `memory` `[N, S]`, empty for a
    /// feed-forward policy. Allocated room is kept.
    pub fn begin(&mut self, memory: &[f32]) {
        self.clear();
        self.memory.extend_from_slice(memory);
    }

    /// Forgets all steps; allocated room is kept.
    pub fn clear(&mut self) {
        self.len = 0;
        self.finished = false;
        self.memory.clear();
        self.observations.clear();
        self.starts.clear();
        self.actions.clear();
        self.log_probs.clear();
        self.values.clear();
        self.rewards.clear();
        self.terminated.clear();
        self.truncated.clear();
        self.truncation_values.clear();
        self.last_values.clear();
    }

    /// Appends a step. A wrong length, or a step too many, changes nothing.
    pub fn push(&mut self, step: RolloutStep<'_>) -> Result<()> {
        if self.is_full() {
            return Err(Error::RolloutLength { got: self.len, expected: self.n_steps, what: "a step was pushed" });
        }
        let n = self.n_envs;
        check_length("observations [N, O]", step.observations.len(), n * self.observation_size)?;
        check_length("starts [N]", step.starts.len(), n)?;
        check_length("actions [N, A]", step.actions.len(), n * self.action_width)?;
        check_length("log_probs [N]", step.log_probs.len(), n)?;
        check_length("values [N]", step.values.len(), n)?;
        check_length("rewards [N]", step.rewards.len(), n)?;
        check_length("terminated [N]", step.terminated.len(), n)?;
        check_length("truncated [N]", step.truncated.len(), n)?;
        check_length("truncation_values [N]", step.truncation_values.len(), n)?;
        self.observations.extend_from_slice(step.observations);
        self.starts.extend_from_slice(step.starts);
        self.actions.extend_from_slice(step.actions);
        self.log_probs.extend_from_slice(step.log_probs);
        self.values.extend_from_slice(step.values);
        self.rewards.extend_from_slice(step.rewards);
        self.terminated.extend_from_slice(step.terminated);
        self.truncated.extend_from_slice(step.truncated);
        self.truncation_values.extend_from_slice(step.truncation_values);
        self.len += 1;
        Ok(())
    }

    /// Sets `last_values` `[N]` = V(s_T), where s_T are the observations after the last step. Comes after the last
    /// [`Rollout::push`] and before an update.
    pub fn finish(&mut self, last_values: &[f32]) -> Result<()> {
        if !self.is_full() {
            return Err(Error::RolloutLength { got: self.len, expected: self.n_steps, what: "it was finished" });
        }
        check_length("last_values [N]", last_values.len(), self.n_envs)?;
        self.last_values.clear();
        self.last_values.extend_from_slice(last_values);
        self.finished = true;
        Ok(())
    }

    /// What advantages are estimated from. An error before [`Rollout::finish`].
    pub fn trajectories(&self) -> Result<Trajectories<'_>> {
        if !self.finished {
            let what = "it was used before it was finished";
            return Err(Error::RolloutLength { got: self.len, expected: self.n_steps, what });
        }
        Ok(Trajectories {
            n_envs: self.n_envs,
            rewards: &self.rewards,
            values: &self.values,
            terminated: &self.terminated,
            truncated: &self.truncated,
            truncation_values: &self.truncation_values,
            last_values: &self.last_values,
        })
    }

    /// Steps pushed since the last `clear`.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether no step was pushed yet.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether T steps were pushed.
    pub fn is_full(&self) -> bool {
        self.len == self.n_steps
    }

    /// T.
    pub fn n_steps(&self) -> usize {
        self.n_steps
    }

    /// N.
    pub fn n_envs(&self) -> usize {
        self.n_envs
    }

    /// O.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// A.
    pub fn action_width(&self) -> usize {
        self.action_width
    }

    /// `[T, N, O]`.
    pub fn observations(&self) -> &[f32] {
        &self.observations
    }

    /// `[T, N]` whether the policy's memory was emptied before the step.
    pub fn starts(&self) -> &[bool] {
        &self.starts
    }

    /// `[N, S]` what the policy remembered before the first step.
    pub fn memory(&self) -> &[f32] {
        &self.memory
    }

    /// `[T, N, A]`.
    pub fn actions(&self) -> &[f32] {
        &self.actions
    }

    /// `[T, N]`.
    pub fn log_probs(&self) -> &[f32] {
        &self.log_probs
    }

    /// `[T, N]`.
    pub fn values(&self) -> &[f32] {
        &self.values
    }
}
