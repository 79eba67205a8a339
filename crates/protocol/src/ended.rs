//! The end of an episode, as clients store it.

use crate::proto;

/// An episode that ended, with the parameters that it ran with.
#[derive(Clone, Debug, PartialEq)]
pub struct EndedEpisode {
    /// The slot in the session's batch, 0 … N-1.
    pub slot: usize,
    /// The environment's index: its place among the environments that were opened together, unless the client gave it or
    /// restored it.
    pub environment_index: u32,
    /// Counts the environment's episodes from 0.
    pub episode_index: u64,
    /// Counts the environment's trials from 0.
    pub trial_index: u64,
    /// Counts the trial's episodes from 0.
    pub episode_in_trial: u32,
    /// The undiscounted sum of the rewards.
    pub episode_return: f64,
    /// The number of steps.
    pub length: u32,
    /// Whether the episode was a success.
    pub success: bool,
    /// Whether the task ended the episode, as opposed to the step limit alone.
    pub terminated: bool,
    /// Whether the physics diverged.
    pub diverged: bool,
    /// The quantity that the environment's success rule compares; `None` if it was never measured.
    pub achieved: Option<f64>,
    /// The quantity that the rule of the paper's published code compares.
    pub code_achieved: Option<f64>,
    /// The requested parameters, and those of the physics, in the catalogue's order.
    pub receipt: proto::Receipt,
}

impl EndedEpisode {
    /// The end of an episode in `slot` of the batch, from a server's message; `None` if the message lacks the episode's address
    /// or the receipt.
    pub fn from_proto(end: proto::EpisodeEnd, slot: usize, terminated: bool) -> Option<Self> {
        let (episode, receipt) = end.episode.zip(end.receipt)?;
        Some(Self {
            slot,
            environment_index: episode.environment_index,
            episode_index: episode.episode_index,
            trial_index: episode.trial_index,
            episode_in_trial: episode.episode_in_trial,
            episode_return: end.r#return,
            length: end.length,
            success: end.success,
            terminated,
            diverged: end.diverged,
            achieved: end.achieved,
            code_achieved: end.code_achieved,
            receipt,
        })
    }
}
