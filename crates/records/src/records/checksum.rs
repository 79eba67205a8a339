//! Checksums of a test's episodes.

use sha2::{Digest, Sha256};

use super::{Ending, EpisodeRecord, Records};

impl Records {
    /// Returns the SHA-256 of the episodes of the test on the set called `name`, in hexadecimal; `None` if there are
    /// none. `docs/results-table.md` specifies the bytes that are hashed.
    pub fn checksum(&self, name: &str) -> Option<String> {
        let mut hash = Sha256::new();
        let mut episodes = self.episodes_on(name).peekable();
        episodes.peek()?;
        episodes.for_each(|episode| add(&mut hash, episode));
        Some(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    }
}

/// Adds an episode to the hash. All numbers are little-endian.
fn add(hash: &mut Sha256, episode: &EpisodeRecord) {
    let optional = |hash: &mut Sha256, number: Option<f64>| {
        hash.update([u8::from(number.is_some())]);
        number.iter().for_each(|number| hash.update(number.to_le_bytes()));
    };
    hash.update(episode.seed.to_le_bytes());
    hash.update(episode.environment_index.to_le_bytes());
    hash.update(episode.episode_index.to_le_bytes());
    for value in episode.requested.iter().chain(&episode.applied) {
        hash.update(value.to_le_bytes());
    }
    hash.update(&episode.model_hash);
    hash.update(episode.episode_return.to_le_bytes());
    hash.update(episode.length.to_le_bytes());
    hash.update([u8::from(episode.success)]);
    hash.update([match episode.ending {
        Ending::Terminated => 0,
        Ending::Truncated => 1,
        Ending::Diverged => 2,
    }]);
    optional(hash, episode.achieved);
    optional(hash, episode.also_achieved);
}
