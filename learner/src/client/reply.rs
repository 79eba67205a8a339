//! The reply to a step of a batch.

use std::ops::Range;

use perturb_policy::{SlotEnd, StepOutcome};
use perturb_protocol::EndedEpisode;

/// The reply to a step of N environments. Reuse the same value for all steps, so that its buffers are allocated once.
#[derive(Clone, Debug, Default)]
pub struct StepReply {
    /// Observations `[N, O]`. For an environment whose episode ended, the first observation of its next episode.
    pub observations: Vec<f32>,
    /// Rewards `[N]`.
    pub rewards: Vec<f32>,
    /// Whether the task ended the episode, `[N]`.
    pub terminated: Vec<bool>,
    /// Whether the step limit ended the episode, `[N]`.
    pub truncated: Vec<bool>,
    /// Last observations `[K, O]` of the K ended episodes, in the order of `ended`.
    pub final_observations: Vec<f32>,
    /// The K ended episodes, ordered by slot.
    pub ended: Vec<EndedEpisode>,
}

/// The part of a [`StepReply`] for n successive slots.
#[derive(Clone, Copy, Debug)]
pub struct StepSlice<'a> {
    /// The number of the first slot in the whole batch.
    pub first_slot: usize,
    /// Observations `[n, O]`.
    pub observations: &'a [f32],
    /// Rewards `[n]`.
    pub rewards: &'a [f32],
    /// Whether the task ended the episode, `[n]`.
    pub terminated: &'a [bool],
    /// Whether the step limit ended the episode, `[n]`.
    pub truncated: &'a [bool],
    /// Last observations `[k, O]` of the k ended episodes, in the order of `ended`.
    pub final_observations: &'a [f32],
    /// The k ended episodes. Their slot numbers are those of the whole batch.
    pub ended: &'a [EndedEpisode],
}

impl StepReply {
    /// Returns the whole reply as a slice.
    pub fn all(&self) -> StepSlice<'_> {
        self.slice(0..self.rewards.len())
    }

    /// Returns the part of the reply for the slots of `range`.
    pub fn slice(&self, range: Range<usize>) -> StepSlice<'_> {
        let size = self.observations.len() / self.rewards.len().max(1);
        let place = |slot| self.ended.partition_point(|end| end.slot < slot);
        let ended = place(range.start)..place(range.end);
        StepSlice {
            first_slot: range.start,
            observations: &self.observations[range.start * size..range.end * size],
            rewards: &self.rewards[range.clone()],
            terminated: &self.terminated[range.clone()],
            truncated: &self.truncated[range],
            final_observations: &self.final_observations[ended.start * size..ended.end * size],
            ended: &self.ended[ended],
        }
    }

    /// Resizes the arrays for N environments, and removes ended episodes.
    pub(super) fn resize(&mut self, num_envs: usize, observation_size: usize) {
        self.observations.resize(num_envs * observation_size, 0.0);
        self.rewards.resize(num_envs, 0.0);
        self.terminated.resize(num_envs, false);
        self.truncated.resize(num_envs, false);
        self.final_observations.clear();
        self.ended.clear();
    }
}

impl<'a> StepSlice<'a> {
    /// Converts the slice to the input of a player that plays these slots. Writes the ended episodes into the buffer
    /// `ended`.
    pub fn outcome(&self, ended: &'a mut Vec<SlotEnd>) -> StepOutcome<'a> {
        ended.clear();
        ended.extend(self.ended.iter().map(|end| SlotEnd {
            slot: end.slot - self.first_slot,
            trial_index: end.trial_index,
            episode_in_trial: end.episode_in_trial,
        }));
        StepOutcome {
            observations: self.observations,
            rewards: self.rewards,
            terminated: self.terminated,
            truncated: self.truncated,
            final_observations: self.final_observations,
            ended,
        }
    }
}
