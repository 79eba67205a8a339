//! Receipts as arrays, so that a large batch needs no message for each episode.

use crate::env::Episodes;

/// The receipts of some episodes, as columns.
#[derive(Debug, Default)]
pub(super) struct ReceiptColumns {
    /// `[m, 5]`: slot of the batch, indices of environment, trial and episode, and the episode's number in its trial.
    pub(super) episodes: Vec<u64>,
    /// `[m, P + Q]`: the requested values, then the applied ones.
    pub(super) values: Vec<f64>,
}

impl ReceiptColumns {
    /// Removes all receipts.
    pub(super) fn clear(&mut self) {
        self.episodes.clear();
        self.values.clear();
    }

    /// Adds the present episode of the environment in this slot of the batch.
    pub(super) fn push(&mut self, slot: usize, episodes: &Episodes) {
        let id = episodes.id();
        let numbers = [id.environment_index.into(), id.trial_index, id.episode_index, id.episode_in_trial.into()];
        self.episodes.push(slot as u64);
        self.episodes.extend(numbers);
        episodes.push_receipt(&mut self.values);
    }
}
