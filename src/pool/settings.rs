//! The settings with which a batch is opened.

use crate::env::{EnvironmentSpec, EpisodeSettings};

/// The settings with which a batch of environments is opened.
#[derive(Debug, Clone)]
pub struct BatchSettings {
    /// The description of the environment that all slots have.
    pub spec: &'static EnvironmentSpec,
    /// The groups of slots, at least one, in order of slots.
    pub groups: Vec<SlotGroupSettings>,
    /// The autoreset mode, which determines when an environment is reset after the end of an episode.
    pub autoreset: Autoreset,
    /// Whether the starts and ends of episodes are reported with receipts.
    pub receipts: bool,
    /// Whether step results have receipts as arrays instead of as messages.
    pub receipt_arrays: bool,
    /// Whether step results contain the terms of the reward.
    pub reward_terms: bool,
    /// Whether the episode's parameters are appended to observations.
    pub observe_parameters: bool,
}

/// A number of successive slots whose episodes have the same settings.
#[derive(Debug, Clone)]
pub struct SlotGroupSettings {
    /// The number of slots, at least 1.
    pub size: usize,
    /// The settings of the group's episodes. These settings determine all randomness. `environment_index` is the
    /// environment index of the group's first slot. The next slots have the next indices; the last index must fit a
    /// u32.
    pub episodes: EpisodeSettings,
}

impl BatchSettings {
    /// N, the number of environments when the batch is opened.
    pub fn size(&self) -> usize {
        self.groups.iter().map(|group| group.size).sum()
    }

    /// O, the number of entries of an observation.
    pub fn observation_size(&self) -> usize {
        let parameters = if self.observe_parameters { self.spec.parameters.len() } else { 0 };
        self.spec.observation.len() + parameters
    }

    /// The number of episodes in a trial, or `None` if not all groups have the same number.
    pub fn episodes_per_trial(&self) -> Option<u32> {
        let mut each = self.groups.iter().map(|group| group.episodes.episodes_per_trial);
        let first = each.next()?;
        each.all(|other| other == first).then_some(first)
    }
}

/// Gymnasium's three autoreset modes, which determine when an environment is reset after the end of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Autoreset {
    /// The step after the end of an episode resets the environment, and ignores its action.
    NextStep,
    /// The step that ends the episode also resets the environment.
    SameStep,
    /// Only the client resets the environment.
    Disabled,
}
