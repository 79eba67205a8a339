//! The result of an episode, as clients store it.

use crate::proto;

/// The result of an episode that ended, and the physical parameters it ran with.
#[derive(Clone, Debug, PartialEq)]
pub struct EndedEpisode {
    /// The index of the environment in the session's batch, 0 … N-1.
    pub slot: usize,
    /// The environment's index, which with the seed fixes its random numbers. By default, the environments of a session
    /// have the indices 0 … N-1. A client may request another first index, and a restored snapshot contains its
    /// environment's index.
    pub environment_index: u32,
    /// The number of the episode, counted from 0 for each environment.
    pub episode_index: u64,
    /// The number of the trial, counted from 0 for each environment. A trial is a series of episodes with the same
    /// parameters.
    pub trial_index: u64,
    /// The number of the episode in its trial, from 0.
    pub episode_in_trial: u32,
    /// The undiscounted sum of the rewards.
    pub episode_return: f64,
    /// The number of steps.
    pub length: u32,
    /// Whether the episode was a success.
    pub success: bool,
    /// Whether the task ended the episode, e.g. because a pole fell. False if only the step limit ended it.
    pub terminated: bool,
    /// Whether the physics diverged, i.e. its state was no longer finite.
    pub diverged: bool,
    /// The value that the environment's success rule compares with its threshold. `None` if it has no value, e.g. the
    /// time to a goal that was never reached.
    pub achieved: Option<f64>,
    /// The value that the success rule in the published code of Packer et al. (2018) compares with its threshold. The
    /// rule may differ from the one in their paper.
    pub code_achieved: Option<f64>,
    /// The requested parameters, and the values read back from the physics, in the order of the catalogue.
    pub receipt: proto::Receipt,
}

impl EndedEpisode {
    /// Converts a server's message about the environment at index `slot` of the batch. Returns `None` if the message
    /// lacks the episode's numbers or its receipt.
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
