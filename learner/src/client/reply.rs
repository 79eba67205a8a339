//! The reply to a step.

use std::ops::Range;

use perturb_policy::{SlotEnd, StepOutcome};
use perturb_protocol::EndedEpisode;

/// The reply to a step. Its buffers are reused.
#[derive(Clone, Debug, Default)]
pub struct StepReply {
    /// `[N, O]` observations; where an episode ended, the first one of the next.
    pub observations: Vec<f32>,
    /// `[N]` rewards.
    pub rewards: Vec<f32>,
    /// `[N]` whether the task ended the episode.
    pub terminated: Vec<bool>,
    /// `[N]` whether the step limit ended the episode.
    pub truncated: Vec<bool>,
    /// `[K, O]` last observations of the episodes that ended, in the order of `ended`.
    pub final_observations: Vec<f32>,
    /// The K episodes that ended, in order of slots.
    pub ended: Vec<EndedEpisode>,
}

/// The reply to a step for successive slots: the fields of [`StepReply`].
#[derive(Clone, Copy, Debug)]
pub struct StepSlice<'a> {
    /// The first of the slots.
    pub first_slot: usize,
    /// `[n, O]` observations of the n slots.
    pub observations: &'a [f32],
    /// `[n]` rewards.
    pub rewards: &'a [f32],
    /// `[n]` whether the task ended the episode.
    pub terminated: &'a [bool],
    /// `[n]` whether the step limit ended the episode.
    pub truncated: &'a [bool],
    /// `[k, O]` last observations of the k episodes that ended, in the order of `ended`.
    pub final_observations: &'a [f32],
    /// The k episodes that ended. Their slots count over the whole batch.
    pub ended: &'a [EndedEpisode],
}

impl StepReply {
    /// The whole reply.
    pub fn all(&self) -> StepSlice<'_> {
        self.slice(0..self.rewards.len())
    }

    /// The part of the reply for the slots of `range`.
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
    /// The outcome for a player of these slots. `ended` is a buffer for the ends of episodes.
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
