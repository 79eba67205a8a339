//! A policy in one file: the weights, with the checkpoint's JSON document in the metadata.

use std::path::Path;

use perturb_files::checksum::WithChecksum;
use perturb_files::{self as files, has_file, write_atomically};

use super::{
    ArraysFile, Checkpoint, CheckpointDocument, FORMAT_VERSION, Result, State, WEIGHTS_PREFIX, damaged,
    decode_document, decode_weights, encode_policy, encode_weights,
};

/// The extension of policy files.
pub(crate) const SUFFIX: &str = "safetensors";

/// Returns whether `path` is an existing policy file.
pub(crate) fn is_policy(path: &Path) -> Result<bool> {
    Ok(path.extension().is_some_and(|ending| ending == SUFFIX) && has_file(path)?)
}

impl Checkpoint {
    /// Writes the policy to the file `path` atomically. The policy can be tested, but its training cannot be resumed.
    ///
    /// # Errors
    /// [`CheckpointError`](super::CheckpointError) if the file cannot be written.
    pub fn save_file(&self, path: &Path) -> Result<()> {
        let not_written = |reason: String| damaged(path, reason);
        let weights = encode_weights(&self.weights).map_err(not_written)?;
        let not_json = |error: serde_json::Error| damaged(path, error.to_string());
        let document = CheckpointDocument {
            format_version: FORMAT_VERSION,
            weights: ArraysFile::describe(WEIGHTS_PREFIX, self.state.counters.iterations, &weights),
            resume: None,
            rest: serde_json::to_value(&self.state).map_err(not_json)?,
        };
        let sealed = WithChecksum::new(&document).map_err(not_json)?;
        let document = serde_json::to_string(&sealed).map_err(not_json)?;
        let content = encode_policy(&self.weights, document).map_err(not_written)?;
        Ok(write_atomically(path, &content)?)
    }

    /// Reads the policy from the file `path`.
    ///
    /// # Errors
    /// [`CheckpointError`](super::CheckpointError) if the file cannot be read, or if a checksum is wrong.
    pub(crate) fn load_file(path: &Path) -> Result<Self> {
        let content = files::read(path)?;
        let text = decode_document(&content).map_err(|reason| damaged(path, reason))?;
        let document = CheckpointDocument::parse(path, text.as_bytes())?;
        let state = State::from_document(path, document.rest)?;
        let policy = state.policy();
        let weights = decode_weights(&content, &policy).map_err(|reason| damaged(path, reason))?;
        let alone = encode_weights(&weights).map_err(|reason| damaged(path, reason))?;
        document.weights.require_content(&alone).map_err(|reason| damaged(path, format!("its weights: {reason}")))?;
        Ok(Self { state, policy, weights })
    }
}
