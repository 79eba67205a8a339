//! Receipts as arrays. With them, a large batch needs no message for each episode.

use crate::env::Episodes;

/// The receipts of m episodes, as arrays.
#[derive(Debug, Default)]
pub(super) struct ReceiptColumns {
    /// `[m, 5]`: for each episode its slot in the batch, environment index, trial index, episode index, and number
    /// within its trial.
    pub(super) episodes: Vec<u64>,
    /// `[m, P + Q]`: for each episode its P requested values, then its Q applied values.
    pub(super) values: Vec<f64>,
}

impl ReceiptColumns {
    /// Removes all receipts.
    pub(super) fn clear(&mut self) {
        self.episodes.clear();
        self.values.clear();
    }

    /// Adds the receipt of an environment's current episode. `slot` is the environment's slot in the batch.
    pub(super) fn push(&mut self, slot: usize, episodes: &Episodes) {
        let id = episodes.id();
        let numbers = [id.environment_index.into(), id.trial_index, id.episode_index, id.episode_in_trial.into()];
        self.episodes.push(slot as u64);
        self.episodes.extend(numbers);
        episodes.push_receipt(&mut self.values);
    }
}
