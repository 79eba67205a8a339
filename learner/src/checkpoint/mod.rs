//! Saves and loads the state from which a training resumes exactly. It is stored together with the policy's
//! [checkpoint](perturb_checkpoint).
//!
//! Large arrays are in a separate file, so that tests of the policy need not read them. The rest is the field `resume`
//! in `checkpoint.json`.

#[cfg(test)]
mod tests;

use std::path::Path;

use bytes::Bytes;
use perturb_checkpoint::{Array, Arrays, ArraysFile, JSON, RESUME_PREFIX, Result, StoredResumeState, damaged, encode};
use perturb_policy::PlayerTrainingState;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::algorithm::AlgorithmState;
use crate::logging::{EpisodeFigures, LogLengths, TimeShares};
use crate::rollout::CollectorState;
pub use perturb_checkpoint::{Changed, Checkpoint, CheckpointError, EnvironmentSummary, State, find_policy};

/// The state of a training between two iterations, apart from the policy and the counters, which are in the
/// [`Checkpoint`].
#[derive(Clone, Debug, PartialEq)]
pub struct ResumeState {
    /// Snapshots of the environments, and the player's state: observations, recurrent memory, and the random stream
    /// that draws actions.
    pub collector: CollectorState,
    /// The algorithm's state: the optimiser's averages, and the random stream that draws minibatches.
    pub algorithm: AlgorithmState,
    /// Statistics of the whole run so far.
    pub history: History,
}

/// Statistics of the whole run so far, which the logs and the stopping rule need.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct History {
    /// Figures of the most recent episodes, oldest first.
    pub recent: Vec<EpisodeFigures>,
    /// Seconds of training so far.
    pub elapsed: f64,
    /// Seconds spent on each activity. Checkpoints of format 1 store this field and the entries of `recent` as JSON
    /// arrays without field names. Such checkpoints can still be read.
    pub shares: TimeShares,
    /// The lengths of the log files, to which a resumed training cuts them.
    pub logs: LogLengths,
}

/// The content of the field `resume` in `checkpoint.json`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ResumeDocument {
    arrays: ArraysFile,
    /// The algorithm's state, without the data of its arrays, which are in the separate file.
    algorithm: AlgorithmState,
    /// The random stream that draws actions.
    actions: ChaCha8Rng,
    history: History,
}

impl ResumeState {
    /// Saves `checkpoint` together with this state. Replaces an earlier checkpoint in `directory`, see
    /// [`Checkpoint::save`].
    ///
    /// # Errors
    /// [`CheckpointError::File`] if a file cannot be written. An earlier checkpoint then stays intact.
    pub fn save(&self, checkpoint: &Checkpoint, directory: &Path) -> Result<()> {
        let content = self.encode().map_err(|reason| damaged(directory, reason))?;
        let arrays = ArraysFile::write(directory, RESUME_PREFIX, checkpoint.state.counters.iterations, &content)?;
        let mut algorithm = self.algorithm.clone();
        algorithm.optimiser.iter_mut().for_each(|array| array.data.clear());
        let actions = self.collector.player.actions.clone();
        let history = self.history.clone();
        let document = serde_json::to_value(ResumeDocument { arrays: arrays.clone(), algorithm, actions, history });
        let document = document.map_err(|error| damaged(directory, error.to_string()))?;
        checkpoint.save(directory, Some(StoredResumeState { arrays, document }))
    }

    /// Reads the checkpoint in the folder `path`, or in its subfolder `checkpoint`, with the state of its training.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the faulty file.
    pub fn load(path: &Path) -> Result<(Checkpoint, Self)> {
        let (checkpoint, directory, document) = Checkpoint::load_resumable(path)?;
        let not_understood =
            |error: serde_json::Error| damaged(&directory.join(JSON), format!("resume is not understood: {error}"));
        let document: ResumeDocument = serde_json::from_value(document).map_err(not_understood)?;
        let content = document.arrays.read(&directory)?;
        let path = document.arrays.path(&directory);
        let state = document.complete(&content).map_err(|reason| damaged(&path, reason))?;
        Ok((checkpoint, state))
    }

    /// Encodes the large arrays for the separate file.
    fn encode(&self) -> std::result::Result<Vec<u8>, String> {
        let CollectorState { snapshots, player } = &self.collector;
        let PlayerTrainingState { observations, starts, previous_steps, memory, actions: _ } = player;
        let num_envs = starts.len();
        let rows = |data: &[f32]| vec![num_envs, data.len() / num_envs.max(1)];
        let mut arrays = vec![
            Array::u8("snapshots", snapshots.concat()),
            Array::u64("snapshot_lengths", snapshots.iter().map(|snapshot| snapshot.len() as u64)),
            Array::f32("observations", rows(observations), observations),
            Array::u8("starts", starts.iter().map(|&start| u8::from(start)).collect()),
            Array::f32("outcomes", rows(previous_steps), previous_steps),
            Array::f32("memory", rows(memory), memory),
        ];
        for array in &self.algorithm.optimiser {
            arrays.push(Array::f32(optimiser(&array.name), array.shape.clone(), &array.data));
        }
        encode(&arrays)
    }
}

impl ResumeDocument {
    /// Combines the document with the arrays in `content`, the bytes of the separate file. The error is the fault of
    /// that file.
    fn complete(mut self, content: &[u8]) -> std::result::Result<ResumeState, String> {
        let arrays = Arrays::decode(content)?;
        for array in &mut self.algorithm.optimiser {
            array.data = arrays.f32(&optimiser(&array.name))?.data;
        }
        let player = PlayerTrainingState {
            observations: arrays.f32("observations")?.data,
            starts: arrays.u8("starts")?.iter().map(|&start| start != 0).collect(),
            previous_steps: arrays.f32("outcomes")?.data,
            memory: arrays.f32("memory")?.data,
            actions: self.actions,
        };
        let snapshots = cut(arrays.u8("snapshots")?, &arrays.u64("snapshot_lengths")?)?;
        let collector = CollectorState { snapshots, player };
        Ok(ResumeState { collector, algorithm: self.algorithm, history: self.history })
    }
}

/// Returns the name, in the file of arrays, of one of the optimiser's arrays.
fn optimiser(name: &str) -> String {
    format!("optimiser.{name}")
}

/// Divides `bytes` into successive pieces with these `lengths`, which must add up to its length.
fn cut(bytes: &[u8], lengths: &[u64]) -> std::result::Result<Vec<Bytes>, String> {
    let mut rest = Bytes::copy_from_slice(bytes);
    let mut pieces = Vec::with_capacity(lengths.len());
    for &length in lengths {
        match usize::try_from(length).ok().filter(|&length| length <= rest.len()) {
            Some(length) => pieces.push(rest.split_to(length)),
            None => return Err(format!("its snapshots have {} bytes, too few for snapshot_lengths", bytes.len())),
        }
    }
    if rest.is_empty() { Ok(pieces) } else { Err(format!("its snapshots have {} bytes too many", rest.len())) }
}
