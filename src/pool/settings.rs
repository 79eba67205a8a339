//! The settings of a batch.

use crate::env::{EnvironmentSpec, Settings};

/// The settings of a batch.
#[derive(Debug, Clone)]
pub struct BatchSettings {
    /// The environment.
    pub spec: &'static EnvironmentSpec,
    /// The slots, at least one group.
    pub groups: Vec<SlotGroup>,
    /// The autoreset mode.
    pub autoreset: Autoreset,
    /// Whether episodes carry receipts.
    pub receipts: bool,
    /// Whether the receipts in replies to steps are arrays.
    pub receipt_arrays: bool,
    /// Whether steps report the reward's terms.
    pub reward_terms: bool,
    /// Whether observations have the parameters at their end.
    pub observe_parameters: bool,
}

/// Successive slots with settings of their own.
#[derive(Debug, Clone)]
pub struct SlotGroup {
    /// The number of slots, at least 1.
    pub size: usize,
    /// The settings of the group's episodes, which fix all randomness. `environment_index` is the index of the first
    /// slot, and the index of the last slot fits a u32.
    pub episodes: Settings,
}

impl BatchSettings {
    /// N, when the batch is opened.
    pub fn size(&self) -> usize {
        self.groups.iter().map(|group| group.size).sum()
    }

    /// O: the length of an observation.
    pub fn observation_size(&self) -> usize {
        let parameters = if self.observe_parameters { self.spec.parameters.len() } else { 0 };
        self.spec.observation.len() + parameters
    }

    /// Episodes in a trial, if all groups have as many.
    pub fn episodes_per_trial(&self) -> Option<u32> {
        let mut each = self.groups.iter().map(|group| group.episodes.episodes_per_trial);
        let first = each.next()?;
        each.all(|other| other == first).then_some(first)
    }
}

/// The autoreset mode of an environment whose episode has ended (Gymnasium's three modes).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Autoreset {
    /// The next step ignores its action and resets the environment.
    NextStep,
    /// The step that ends the episode also resets the environment.
    SameStep,
    /// The environment is reset only by the client.
    Disabled,
}
