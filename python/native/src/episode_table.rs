//! A table of episodes with their receipts. Infos are built from it.

use perturb_protocol::proto;
use pyo3::prelude::*;

use crate::failure::{MALFORMED, failure};

/// Episodes with their receipts, one row each.
#[derive(Default)]
pub struct EpisodeTable {
    /// For each of `m` episodes: slot in the batch, environment index, trial index, episode index, and the episode's
    /// number in its trial.
    pub episodes: Vec<[u64; 5]>,
    /// `[m, P + Q]`: the requested values of each episode, and then its applied values.
    values: Vec<f64>,
    /// Number of requested values P.
    requested: usize,
    /// Number of requested and applied values P + Q.
    width: usize,
}

impl EpisodeTable {
    /// Makes an empty table for receipts with the given numbers of requested and applied values.
    pub fn new(requested: usize, applied: usize) -> Self {
        Self { requested, width: requested + applied, ..Self::default() }
    }

    /// Adds a row for each message. Skips messages without an episode or without a receipt.
    ///
    /// # Errors
    /// If a receipt has a wrong number of values.
    pub fn with_messages<'a>(mut self, messages: impl Iterator<Item = EpisodeMessage<'a>>) -> PyResult<Self> {
        for (slot, episode, receipt) in messages {
            let (Some(episode), Some(receipt)) = (episode, receipt) else { continue };
            if receipt.requested.len() != self.requested || receipt.applied.len() + self.requested != self.width {
                return Err(mismatched_episodes());
            }
            let proto::Episode { environment_index, trial_index, episode_index, episode_in_trial } = *episode;
            let numbers = [slot.into(), environment_index.into(), trial_index, episode_index, episode_in_trial.into()];
            self.episodes.push(numbers);
            self.values.extend(receipt.requested.iter().chain(&receipt.applied));
        }
        Ok(self)
    }

    /// Decodes the arrays of a reply: `episodes` (uint64 `[m, 5]`) and `values` (float64 `[m, P + Q]`). The rows of the
    /// episodes that ended come first, and `ended` is their number. Returns a table of these episodes, and a table of
    /// the episodes that began.
    ///
    /// # Errors
    /// If the lengths of the arrays do not match.
    pub fn split(&self, episodes: &[u8], values: &[u8], ended: usize) -> PyResult<[Self; 2]> {
        let (words, numbers) = (episodes.as_chunks::<8>().0, values.as_chunks::<8>().0);
        let m = words.len() / 5;
        if episodes.len() != m * 40 || values.len() != m * self.width * 8 || m < ended {
            return Err(mismatched_episodes());
        }
        let part = |from: usize, to: usize| Self {
            episodes: words.as_chunks::<5>().0[from..to].iter().map(|row| row.map(u64::from_le_bytes)).collect(),
            values: numbers[from * self.width..to * self.width].iter().map(|word| f64::from_le_bytes(*word)).collect(),
            ..*self
        };
        Ok([part(0, ended), part(ended, m)])
    }

    /// Returns the episodes, each with its requested and applied values.
    pub fn rows(&self) -> impl Iterator<Item = ([u64; 5], &[f64])> {
        self.episodes.iter().copied().zip(self.values.chunks(self.width.max(1)))
    }

    /// Returns the receipt of the episode in row `index`, with the given model hash. Returns `None` without such a row.
    pub fn receipt(&self, index: usize, model_hash: &str) -> Option<proto::Receipt> {
        let (_, values) = self.rows().nth(index)?;
        let (requested, applied) = values.split_at(self.requested);
        Some(proto::Receipt { requested: requested.into(), applied: applied.into(), model_hash: model_hash.into() })
    }
}

/// The content of a message about an episode: its slot, its indices and its receipt. A message may lack the latter two.
pub type EpisodeMessage<'a> = (u32, Option<&'a proto::Episode>, Option<&'a proto::Receipt>);

/// Returns the error for a reply whose episodes or receipts do not fit the session.
pub fn mismatched_episodes() -> PyErr {
    failure(MALFORMED, 0, "the server sent episodes that do not fit the batch, or receipts of a wrong length")
}
