//! The buffer of a rollout.

use super::advantage::{Estimates, Trajectories};
use crate::error::{Error, Result};
use perturb_policy::{RolloutStep, Samples, SequenceSamples, check_length};

/// The position of a complete episode in a rollout, and its return.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpisodeSlice {
    /// The index of the environment, 0 … N-1.
    pub environment: usize,
    /// The index of the first step, 0 … T-1.
    pub start: usize,
    /// The number of steps.
    pub length: usize,
    /// The undiscounted sum of the episode's rewards before normalisation.
    pub episode_return: f64,
}

/// The collected experience of T steps in N environments. Arrays are row-major [T, N, …], so that a step is appended as
/// one piece. Flattened to T·N samples, sample t·N + n is step t of environment n.
///
/// A rollout of complete episodes (for EPOpt) has no fixed T: it grows until it is finished, and also lists its
/// episodes.
#[derive(Clone, Debug)]
pub struct RolloutBuffer {
    /// T, or `None` for a rollout of complete episodes, whose length is not fixed.
    fixed_steps: Option<usize>,
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
    episodes: Vec<EpisodeSlice>,
    lengths: Option<Vec<usize>>,
}

impl RolloutBuffer {
    /// Returns an empty rollout for T = `n_steps`, N = `n_envs`, O = `observation_size` and A = `action_width` (see
    /// [`ActionKind::width`](perturb_policy::ActionKind::width)). Allocates all memory in advance.
    pub fn new(n_steps: usize, n_envs: usize, observation_size: usize, action_width: usize) -> Self {
        Self::with_capacity(Some(n_steps), n_steps, n_envs, observation_size, action_width)
    }

    /// Returns an empty rollout for complete episodes. It grows with every step until [`RolloutBuffer::finish`].
    pub fn of_episodes(n_envs: usize, observation_size: usize, action_width: usize) -> Self {
        Self::with_capacity(None, 0, n_envs, observation_size, action_width)
    }

    /// Returns an empty rollout with room for `capacity` steps. `fixed_steps` is T; `None` for complete episodes.
    fn with_capacity(
        fixed_steps: Option<usize>,
        capacity: usize,
        n_envs: usize,
        observation_size: usize,
        action_width: usize,
    ) -> Self {
        let size = capacity * n_envs;
        RolloutBuffer {
            fixed_steps,
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
            episodes: Vec::new(),
            lengths: None,
        }
    }

    /// Starts a new rollout: removes all steps, and stores `memory` `[N, S]`, the policy's recurrent memory before the
    /// first step. S is the number of values per environment, 0 for a feed-forward policy. Keeps the allocated
    /// capacity.
    pub fn begin(&mut self, memory: &[f32]) {
        self.clear();
        self.memory.extend_from_slice(memory);
    }

    /// Removes all steps. Keeps the allocated capacity.
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
        self.episodes.clear();
        self.lengths = None;
    }

    /// Appends one step, or several steps whose arrays are `[T, N, …]`. Returns an error, and changes nothing, if an
    /// array has a wrong length or there are too many steps.
    pub fn push(&mut self, step: RolloutStep<'_>) -> Result<()> {
        let steps = (step.rewards.len() / self.n_envs).max(1);
        if self.fixed_steps.is_some_and(|fixed_steps| self.len + steps > fixed_steps) {
            return Err(Error::RolloutLength { got: self.len, expected: self.n_steps(), what: "a step was pushed" });
        }
        let n = steps * self.n_envs;
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
        self.len += steps;
        Ok(())
    }

    /// Finishes the rollout. `last_values` `[N]` are V(s_T), the values of the observations after the last step. Must
    /// be called after the last [`RolloutBuffer::push`] and before an update.
    pub fn finish(&mut self, last_values: &[f32]) -> Result<()> {
        if !self.is_full() && self.fixed_steps.is_some() {
            return Err(Error::RolloutLength { got: self.len, expected: self.n_steps(), what: "it was finished" });
        }
        check_length("last_values [N]", last_values.len(), self.n_envs)?;
        self.last_values.clear();
        self.last_values.extend_from_slice(last_values);
        self.finished = true;
        Ok(())
    }

    /// Returns the arrays from which advantages are estimated.
    ///
    /// # Errors
    /// [`Error::RolloutLength`] before [`RolloutBuffer::finish`].
    pub fn trajectories(&self) -> Result<Trajectories<'_>> {
        if !self.finished {
            let what = "it was used before it was finished";
            return Err(Error::RolloutLength { got: self.len, expected: self.n_steps(), what });
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

    /// Returns the training samples of the rollout, with the `estimates` of its advantages and returns.
    pub fn sequences<'a>(&'a self, estimates: &'a Estimates) -> SequenceSamples<'a> {
        let samples = Samples {
            observations: &self.observations,
            actions: &self.actions,
            old_log_probs: &self.log_probs,
            old_values: &self.values,
            advantages: &estimates.advantages,
            returns: &estimates.returns,
            acting: None,
        };
        let n_steps = self.n_steps();
        SequenceSamples { samples, n_steps, starts: &self.starts, memory: &self.memory, lengths: self.lengths() }
    }

    /// Returns the number of steps since the rollout was last cleared.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether the rollout has no steps.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns whether the rollout has all its T steps. Always false for a rollout of complete episodes.
    pub fn is_full(&self) -> bool {
        self.fixed_steps == Some(self.len)
    }

    /// Returns T, the number of steps: the fixed number, or the steps so far in a rollout of complete episodes.
    pub fn n_steps(&self) -> usize {
        self.fixed_steps.unwrap_or(self.len)
    }

    /// Records that an episode of `length` steps has ended. `end` is the index, from 0, of the step after its last
    /// step. All steps of the episode must be in the rollout.
    ///
    /// # Errors
    /// [`Error::Episode`] if the episode has no steps, starts before the rollout or ends after it, or if there is no
    /// such environment.
    pub fn note_episode(&mut self, environment: usize, end: usize, length: usize, episode_return: f64) -> Result<()> {
        self.check_episode(environment, end, length)?;
        self.episodes.push(EpisodeSlice { environment, start: end - length, length, episode_return });
        Ok(())
    }

    /// Returns an error unless `length` is at least 1 and the `length` steps of `environment` before step `end` are in
    /// the rollout.
    fn check_episode(&self, environment: usize, end: usize, length: usize) -> Result<()> {
        let n_envs = self.n_envs;
        let n_steps = self.len;
        if environment < n_envs && (1..=end).contains(&length) && end <= n_steps {
            return Ok(());
        }
        Err(Error::Episode { environment, end, length, n_envs, n_steps })
    }

    /// Returns the complete episodes, in the order in which they ended.
    pub fn episodes(&self) -> &[EpisodeSlice] {
        &self.episodes
    }

    /// Returns the sum of stored rewards of each complete episode, in the order of [`RolloutBuffer::episodes`]. Stored
    /// rewards are normalised if reward normalisation is on.
    pub fn normalized_returns(&self) -> Vec<f64> {
        let reward = |step: usize, environment: usize| f64::from(self.rewards[step * self.n_envs + environment]);
        let sum = |span: &EpisodeSlice| {
            (span.start..span.start + span.length).map(|step| reward(step, span.environment)).sum()
        };
        self.episodes.iter().map(sum).collect()
    }

    /// Returns a new rollout with only the given episodes. Its T is the length of the longest episode. A column (an
    /// environment of the new rollout) may have several short episodes one after another. The rest of a column is
    /// padding, which is not sampled. Every episode starts with an empty recurrent memory.
    ///
    /// # Errors
    /// An error if `episodes` is empty, or one of them is not in this rollout.
    pub fn select(&self, episodes: &[EpisodeSlice]) -> Result<RolloutBuffer> {
        let longest = episodes.iter().map(|episode| episode.length).max().unwrap_or(0);
        if longest == 0 {
            return Err(Error::RolloutLength { got: 0, expected: 1, what: "its episodes were selected" });
        }
        for &EpisodeSlice { environment, start, length, .. } in episodes {
            self.check_episode(environment, start.saturating_add(length), length)?;
        }
        let columns = pack(episodes, longest);
        let mut selected = self.padding(longest, columns.len());
        let o = self.observation_size;
        let a = self.action_width;
        let count = columns.len();
        let mut lengths = Vec::with_capacity(count);
        for (column, episodes) in columns.iter().enumerate() {
            let mut t = 0;
            for episode in episodes {
                selected.starts[t * count + column] = true;
                for step in 0..episode.length {
                    let from = (episode.start + step) * self.n_envs + episode.environment;
                    let to = t * count + column;
                    selected.observations[to * o..][..o].copy_from_slice(&self.observations[from * o..][..o]);
                    selected.actions[to * a..][..a].copy_from_slice(&self.actions[from * a..][..a]);
                    selected.log_probs[to] = self.log_probs[from];
                    selected.values[to] = self.values[from];
                    selected.rewards[to] = self.rewards[from];
                    selected.truncation_values[to] = self.truncation_values[from];
                    selected.terminated[to] = self.terminated[from];
                    selected.truncated[to] = self.truncated[from];
                    t += 1;
                }
            }
            lengths.push(t);
        }
        selected.lengths = Some(lengths);
        Ok(selected)
    }

    /// Returns a finished rollout that has only padding.
    fn padding(&self, n_steps: usize, n_envs: usize) -> RolloutBuffer {
        let size = n_steps * n_envs;
        let memory_size = self.memory.len() / self.n_envs;
        RolloutBuffer {
            len: n_steps,
            finished: true,
            observations: vec![0.0; size * self.observation_size],
            starts: vec![false; size],
            actions: vec![0.0; size * self.action_width],
            log_probs: vec![0.0; size],
            values: vec![0.0; size],
            rewards: vec![0.0; size],
            terminated: vec![true; size], // so the estimates of an episode do not depend on padding
            truncated: vec![false; size],
            truncation_values: vec![0.0; size],
            last_values: vec![0.0; n_envs],
            memory: vec![0.0; n_envs * memory_size],
            ..RolloutBuffer::with_capacity(Some(n_steps), 0, n_envs, self.observation_size, self.action_width)
        }
    }

    /// Returns for each environment `[N]` how many of its first steps are samples; the others are padding. Returns
    /// `None` if all steps are samples.
    pub fn lengths(&self) -> Option<&[usize]> {
        self.lengths.as_deref()
    }

    /// Returns the indices t·N + n of all samples, in ascending order. Returns `None` if all steps are samples.
    pub fn samples(&self) -> Option<Vec<u32>> {
        let lengths = self.lengths.as_ref()?;
        let places = (0..self.len).flat_map(|t| (0..self.n_envs).map(move |n| (t, n)));
        Some(places.filter(|&(t, n)| t < lengths[n]).map(|(t, n)| (t * self.n_envs + n) as u32).collect())
    }

    /// Returns N, the number of environments.
    pub fn n_envs(&self) -> usize {
        self.n_envs
    }

    /// Returns O, the length of an observation.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Returns A, the width of an action.
    pub fn action_width(&self) -> usize {
        self.action_width
    }

    /// Returns the observations `[T, N, O]`.
    pub fn observations(&self) -> &[f32] {
        &self.observations
    }

    /// Returns whether the policy's recurrent memory was reset before the step, `[T, N]`.
    pub fn starts(&self) -> &[bool] {
        &self.starts
    }

    /// Returns the policy's recurrent memory before the first step, `[N, S]`, as given to [`RolloutBuffer::begin`].
    pub fn memory(&self) -> &[f32] {
        &self.memory
    }

    /// Returns the actions `[T, N, A]`.
    pub fn actions(&self) -> &[f32] {
        &self.actions
    }

    /// Returns the log probabilities of the actions under the policy that acted, `[T, N]`.
    pub fn log_probs(&self) -> &[f32] {
        &self.log_probs
    }

    /// Returns the values that the policy predicted when it acted, `[T, N]`.
    pub fn values(&self) -> &[f32] {
        &self.values
    }
}

/// Distributes episodes over columns of `height` steps: takes the longest first, and puts each into the first column
/// with enough room.
fn pack(episodes: &[EpisodeSlice], height: usize) -> Vec<Vec<EpisodeSlice>> {
    let mut sorted = episodes.to_vec();
    sorted.sort_by_key(|episode| std::cmp::Reverse(episode.length)); // a stable sort, so episodes of equal length keep their order
    let mut columns: Vec<(usize, Vec<EpisodeSlice>)> = Vec::new();
    for episode in sorted {
        match columns.iter_mut().find(|(used, _)| used + episode.length <= height) {
            Some((used, column)) => {
                *used += episode.length;
                column.push(episode);
            }
            None => columns.push((episode.length, vec![episode])),
        }
    }
    columns.into_iter().map(|(_, column)| column).collect()
}
