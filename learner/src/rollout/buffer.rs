//! The rollout buffer.

use super::advantage::{Estimates, Trajectories};
use crate::error::{Error, Result};
use perturb_policy::{RolloutStep, Samples, SequenceSamples, check_length};

/// A complete episode in a rollout.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpisodeSlice {
    /// The environment, 0 … N-1.
    pub environment: usize,
    /// The first step, 0 … T-1.
    pub start: usize,
    /// The number of steps.
    pub length: usize,
    /// The undiscounted sum of its rewards, before they were normalised.
    pub episode_return: f64,
}

/// T steps of N environments. Arrays are row-major [T, N, …], so that a step is pushed as one piece; flattened to
/// T·N samples, sample t·N + n is step t of environment n.
///
/// A rollout of complete episodes takes steps until it is finished, and lists the episodes.
#[derive(Clone, Debug)]
pub struct Rollout {
    /// T, if it is fixed beforehand.
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

impl Rollout {
    /// An empty rollout for T = `n_steps`, N = `n_envs`, O = `observation_size` and A = `action_width` (see
    /// [`ActionKind::width`](perturb_policy::ActionKind::width)). Allocates everything that it will need.
    pub fn new(n_steps: usize, n_envs: usize, observation_size: usize, action_width: usize) -> Self {
        Self::with_capacity(Some(n_steps), n_steps, n_envs, observation_size, action_width)
    }

    /// An empty rollout for complete episodes. It grows with every step until [`Rollout::finish`].
    pub fn of_episodes(n_envs: usize, observation_size: usize, action_width: usize) -> Self {
        Self::with_capacity(None, 0, n_envs, observation_size, action_width)
    }

    fn with_capacity(
        fixed_steps: Option<usize>,
        capacity: usize,
        n_envs: usize,
        observation_size: usize,
        action_width: usize,
    ) -> Self {
        let size = capacity * n_envs;
        Rollout {
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

    /// Clears the rollout, and stores the policy's memory before the first step: `memory` `[N, S]`, empty for a feed-forward
    /// policy. Allocated capacity is kept.
    pub fn begin(&mut self, memory: &[f32]) {
        self.clear();
        self.memory.extend_from_slice(memory);
    }

    /// Removes all steps. Allocated capacity is kept.
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

    /// Appends a step, or several, whose arrays are `[T, N, …]`. A wrong length, or a step too many, changes nothing.
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

    /// Sets `last_values` `[N]` = V(s_T), where s_T are the observations after the last step. Comes after the last
    /// [`Rollout::push`] and before an update.
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

    /// The arrays that advantages are estimated from.
    ///
    /// # Errors
    /// [`Error::RolloutLength`] before [`Rollout::finish`].
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

    /// The rollout as a policy learns from it, with what was estimated from it.
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

    /// Steps pushed since the last `clear`.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether no step was pushed yet.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether T steps were pushed, if T is fixed beforehand.
    pub fn is_full(&self) -> bool {
        self.fixed_steps == Some(self.len)
    }

    /// T.
    pub fn n_steps(&self) -> usize {
        self.fixed_steps.unwrap_or(self.len)
    }

    /// Adds an episode of `length` steps that ended before step `end`, counted from 0. All its steps must be in the
    /// rollout.
    ///
    /// # Errors
    /// [`Error::Episode`] if the episode has no steps, starts before the rollout, ends after it, or if there is no such
    /// environment.
    pub fn note_episode(&mut self, environment: usize, end: usize, length: usize, episode_return: f64) -> Result<()> {
        self.check_episode(environment, end, length)?;
        self.episodes.push(EpisodeSlice { environment, start: end - length, length, episode_return });
        Ok(())
    }

    /// Whether the `length` steps before step `end` of `environment` are in the rollout, and at least one.
    fn check_episode(&self, environment: usize, end: usize, length: usize) -> Result<()> {
        let n_envs = self.n_envs;
        let n_steps = self.len;
        if environment < n_envs && (1..=end).contains(&length) && end <= n_steps {
            return Ok(());
        }
        Err(Error::Episode { environment, end, length, n_envs, n_steps })
    }

    /// The complete episodes, in the order in which they ended.
    pub fn episodes(&self) -> &[EpisodeSlice] {
        &self.episodes
    }

    /// The sums of the complete episodes' rewards as stored, normalised if rewards are, in the order of
    /// [`Rollout::episodes`].
    pub fn normalized_returns(&self) -> Vec<f64> {
        let reward = |step: usize, environment: usize| f64::from(self.rewards[step * self.n_envs + environment]);
        let sum = |span: &EpisodeSlice| {
            (span.start..span.start + span.length).map(|step| reward(step, span.environment)).sum()
        };
        self.episodes.iter().map(sum).collect()
    }

    /// A rollout of only the given episodes of this one. T is the length of the longest episode. Shorter ones share a
    /// column, one after another, where they fit. The rest of a column is padding, which is not sampled. Every episode
    /// begins with an empty memory.
    ///
    /// # Errors
    /// There is no episode, or the rollout does not hold one of them.
    pub fn select(&self, episodes: &[EpisodeSlice]) -> Result<Rollout> {
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

    /// A finished rollout of nothing but padding.
    fn padding(&self, n_steps: usize, n_envs: usize) -> Rollout {
        let size = n_steps * n_envs;
        let memory_size = self.memory.len() / self.n_envs;
        Rollout {
            len: n_steps,
            finished: true,
            observations: vec![0.0; size * self.observation_size],
            starts: vec![false; size],
            actions: vec![0.0; size * self.action_width],
            log_probs: vec![0.0; size],
            values: vec![0.0; size],
            rewards: vec![0.0; size],
            terminated: vec![true; size], // nothing flows from padding into an episode
            truncated: vec![false; size],
            truncation_values: vec![0.0; size],
            last_values: vec![0.0; n_envs],
            memory: vec![0.0; n_envs * memory_size],
            ..Rollout::with_capacity(Some(n_steps), 0, n_envs, self.observation_size, self.action_width)
        }
    }

    /// `[N]` the number of first steps of each environment that are samples; None if all steps are.
    pub fn lengths(&self) -> Option<&[usize]> {
        self.lengths.as_deref()
    }

    /// Indices t·N + n of the samples, in order; None if every step is a sample.
    pub fn samples(&self) -> Option<Vec<u32>> {
        let lengths = self.lengths.as_ref()?;
        let places = (0..self.len).flat_map(|t| (0..self.n_envs).map(move |n| (t, n)));
        Some(places.filter(|&(t, n)| t < lengths[n]).map(|(t, n)| (t * self.n_envs + n) as u32).collect())
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

    /// `[N, S]` the policy's memory before the first step.
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

/// Puts episodes into columns of `height` steps, the longest first, each into the first column in which it fits.
fn pack(episodes: &[EpisodeSlice], height: usize) -> Vec<Vec<EpisodeSlice>> {
    let mut sorted = episodes.to_vec();
    sorted.sort_by_key(|episode| std::cmp::Reverse(episode.length)); // keeps the order of equally long ones
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
