//! Checkpoints: a directory with `checkpoint.json` and the weights file that it names.
//!
//! Writing is atomic: the weights get a new name first, then `checkpoint.json`, which names them with their size and
//! checksum, is renamed into place, and only then the old weights are deleted. Whatever moment the program or the
//! machine dies at, the directory holds a complete checkpoint, the old one or the new one.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use crate::config::{AlgorithmName, Architecture, TrainConfig, Wrapper};
use crate::evaluation::Version;
use crate::policy::{ActionKind, Inputs, NamedArray, ObservationNormaliser, PolicySpec, RewardNormaliser, Weights};
use crate::proto;

/// Of the JSON's layout; raised when older programs could misread it.
const FORMAT_VERSION: u32 = 1;
const JSON: &str = "checkpoint.json";
const WEIGHTS_PREFIX: &str = "weights-";
const WEIGHTS_SUFFIX: &str = ".safetensors";
/// Files that a write has not finished.
const TEMPORARY_PREFIX: &str = ".tmp-";

/// A trained policy with everything that testing needs.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Everything but the weights.
    pub state: State,
    /// The policy's weights, in the order of [`PolicySpec::layout`].
    pub weights: Weights,
}

/// Everything in a checkpoint but the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct State {
    /// The environment's name in the catalogue.
    pub environment: String,
    /// What the environment was like.
    pub environment_spec: EnvironmentSummary,
    /// What learned.
    pub algorithm: AlgorithmName,
    /// What acts.
    pub architecture: Architecture,
    /// The shape of the policy.
    pub policy: PolicySpec,
    /// Where the parameters came from while training.
    pub train_version: Version,
    /// Episodes in a trial; 1 without trials.
    #[serde(default = "one")]
    pub episodes_per_trial: u32,
    /// The seed of the training.
    pub seed: u64,
    /// The statistics of observations; `None` if they were not normalised.
    pub observation_normaliser: Option<ObservationNormaliser>,
    /// The statistics of rewards; `None` if they were not normalised.
    pub reward_normaliser: Option<RewardNormaliser>,
    /// How far the training had come.
    pub counters: Counters,
    /// The training's configuration, flat, as in `config.toml`.
    pub config: toml::Table,
}

fn one() -> u32 {
    1
}

/// What an environment must still be for a policy to fit it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSummary {
    /// Raised by every change of dynamics, reward or observation.
    pub revision: u32,
    /// An episode is truncated after this many steps.
    pub step_limit: u32,
    /// Names of the entries of an observation.
    pub observation: Vec<String>,
    /// The actions.
    pub action: ActionKind,
    /// Names of the parameters.
    pub parameters: Vec<String>,
    /// SHA-256 of the model; empty without one.
    pub model_hash: String,
}

/// How far a training has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counters {
    /// Rollouts and updates.
    pub iterations: u64,
    /// Steps of all environments together; EPOpt's are those of complete episodes.
    pub timesteps: u64,
    /// Episodes that the budget counts: those that ended or, with EPOpt, those that it learned from.
    pub episodes: u64,
    /// Episodes that ended; EPOpt generates more than it learns from.
    #[serde(default)]
    pub generated_episodes: u64,
    /// Steps that were learned from.
    #[serde(default)]
    pub learned_timesteps: u64,
}

/// `checkpoint.json`.
#[derive(Serialize, Deserialize)]
struct Document {
    format_version: u32,
    weights: WeightsFile,
    #[serde(flatten)]
    rest: serde_json::Value,
}

/// Names the weights file and says how to tell whether it is whole.
#[derive(Serialize, Deserialize)]
struct WeightsFile {
    file: String,
    bytes: u64,
    crc32c: u32,
}

/// Why a checkpoint cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The operating system refused a file.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// Its answer.
        source: std::io::Error,
    },
    /// There is no checkpoint.
    #[error(
        "{} holds no checkpoint: expected checkpoint.json there or in its folder checkpoint/; give the --out of a \
         training",
        path.display()
    )]
    Missing {
        /// What was given.
        path: PathBuf,
    },
    /// A file is damaged, or was written by a program that is too different.
    #[error("{} is not a usable checkpoint: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

type Result<T> = std::result::Result<T, CheckpointError>;

impl Checkpoint {
    /// Replaces the checkpoint in `directory`, which is created if it is not there.
    ///
    /// # Errors
    /// [`CheckpointError::Io`]; the earlier checkpoint, if any, is then still there.
    pub fn save(&self, directory: &Path) -> Result<()> {
        fs::create_dir_all(directory).map_err(io("create", directory))?;
        let weights = encode_weights(&self.weights).map_err(|reason| damaged(directory, reason))?;
        let crc = crc32c::crc32c(&weights);
        // The checksum is part of the name: a file that is in use is never written over by another content.
        let name = format!("{WEIGHTS_PREFIX}{:08}-{crc:08x}{WEIGHTS_SUFFIX}", self.state.counters.iterations);
        write_atomically(directory, &name, &weights)?;

        let document = Document {
            format_version: FORMAT_VERSION,
            weights: WeightsFile { file: name.clone(), bytes: weights.len() as u64, crc32c: crc },
            rest: serde_json::to_value(&self.state).map_err(|error| damaged(directory, error.to_string()))?,
        };
        let json = serde_json::to_vec_pretty(&document).map_err(|error| damaged(directory, error.to_string()))?;
        write_atomically(directory, JSON, &json)?;
        remove_others(directory, &name)
    }

    /// Reads the checkpoint in `path`, or in its folder `checkpoint`.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the file.
    pub fn load(path: &Path) -> Result<Self> {
        let directory = [path.to_owned(), path.join("checkpoint")]
            .into_iter()
            .find(|directory| directory.join(JSON).is_file())
            .ok_or_else(|| CheckpointError::Missing { path: path.to_owned() })?;
        let json = directory.join(JSON);
        let text = fs::read(&json).map_err(io("read", &json))?;
        let document: Document =
            serde_json::from_slice(&text).map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        if document.format_version != FORMAT_VERSION {
            let reason = format!("it has format {}, this program reads {FORMAT_VERSION}", document.format_version);
            return Err(damaged(&json, reason));
        }
        let state: State = serde_json::from_value(document.rest)
            .map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        let wrong = |name: &str, reason: String| damaged(&json, format!("{name}: {reason}"));
        if let Some(normaliser) = &state.observation_normaliser {
            normaliser
                .check(state.environment_spec.observation.len())
                .map_err(|reason| wrong("observation_normaliser", reason))?;
        }
        if let Some(normaliser) = &state.reward_normaliser {
            normaliser.check().map_err(|reason| wrong("reward_normaliser", reason))?;
        }

        let file = Path::new(&document.weights.file).file_name().unwrap_or_default();
        let file = directory.join(file);
        let bytes = fs::read(&file).map_err(io("read", &file))?;
        if bytes.len() as u64 != document.weights.bytes || crc32c::crc32c(&bytes) != document.weights.crc32c {
            let expected = document.weights.bytes;
            let reason = format!("it has {} bytes, expected {expected} with another checksum", bytes.len());
            return Err(damaged(&file, reason));
        }
        let weights = decode_weights(&bytes, &state.policy).map_err(|reason| damaged(&file, reason))?;
        Ok(Self { state, weights })
    }

    /// The configuration of the training.
    ///
    /// # Errors
    /// A configuration that this program does not understand.
    pub fn config(&self) -> std::result::Result<TrainConfig, crate::config::ConfigError> {
        TrainConfig::from_table("the checkpoint's configuration", self.state.config.clone())
    }
}

impl State {
    /// What the policy gets to see of `n_envs` environments at the start of a trial.
    pub fn inputs(&self, n_envs: usize) -> Inputs {
        let with_outcomes = self.algorithm.wrapper() == Wrapper::Rl2;
        Inputs::new(self.environment_spec.observation.len(), self.policy.action, n_envs, with_outcomes)
    }
}

impl EnvironmentSummary {
    /// What a checkpoint keeps of an environment; `None` if its action space is not given.
    pub fn of(environment: &proto::Environment) -> Option<Self> {
        let action = match environment.action.as_ref()?.kind.as_ref()? {
            proto::action_space::Kind::Discrete(discrete) => ActionKind::Discrete { n: discrete.names.len() },
            proto::action_space::Kind::Continuous(box_) => ActionKind::Continuous { size: box_.channels.len() },
        };
        let names = |channels: &[proto::Channel]| channels.iter().map(|channel| channel.name.clone()).collect();
        Some(Self {
            revision: environment.revision,
            step_limit: environment.step_limit,
            observation: names(&environment.observation),
            action,
            parameters: environment.parameters.iter().map(|parameter| parameter.name.clone()).collect(),
            model_hash: environment.model_hash.clone(),
        })
    }
}

fn encode_weights(weights: &Weights) -> std::result::Result<Vec<u8>, String> {
    let bytes: Vec<Vec<u8>> =
        weights.iter().map(|array| array.data.iter().flat_map(|x| x.to_le_bytes()).collect()).collect();
    let views: Vec<(&str, TensorView<'_>)> = weights
        .iter()
        .zip(&bytes)
        .map(|(array, bytes)| Ok((array.name.as_str(), TensorView::new(Dtype::F32, array.shape.clone(), bytes)?)))
        .collect::<std::result::Result<_, safetensors::SafeTensorError>>()
        .map_err(|error| error.to_string())?;
    let metadata = HashMap::from([("format".to_owned(), "perturb".to_owned())]);
    safetensors::serialize(views, Some(metadata)).map_err(|error| error.to_string())
}

fn decode_weights(bytes: &[u8], spec: &PolicySpec) -> std::result::Result<Weights, String> {
    spec.validate().map_err(|error| error.to_string())?;
    let tensors = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
    let layout = spec.layout();
    if tensors.len() != layout.len() {
        return Err(format!("it has {} arrays, expected {}", tensors.len(), layout.len()));
    }
    let mut weights = Weights::new();
    for (name, _) in layout {
        let tensor = tensors.tensor(&name).map_err(|error| error.to_string())?;
        if tensor.dtype() != Dtype::F32 {
            return Err(format!("{name} has the type {:?}, expected F32", tensor.dtype()));
        }
        let data = tensor.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        weights.push(NamedArray { name, shape: tensor.shape().to_vec(), data });
    }
    spec.check(&weights).map_err(|error| error.to_string())?;
    Ok(weights)
}

/// Writes `name` in one piece: it appears complete, and on the disk, or not at all.
fn write_atomically(directory: &Path, name: &str, content: &[u8]) -> Result<()> {
    let temporary = directory.join(format!("{TEMPORARY_PREFIX}{name}"));
    let mut file = File::create(&temporary).map_err(io("create", &temporary))?;
    file.write_all(content).and_then(|()| file.sync_all()).map_err(io("write", &temporary))?;
    let path = directory.join(name);
    fs::rename(&temporary, &path).map_err(io("rename a file to", &path))?;
    File::open(directory).and_then(|directory| directory.sync_all()).map_err(io("sync", directory))
}

/// Deletes weights that no checkpoint names, and what broken-off writes left.
fn remove_others(directory: &Path, current: &str) -> Result<()> {
    for entry in fs::read_dir(directory).map_err(io("list", directory))? {
        let name = entry.map_err(io("list", directory))?.file_name();
        let name = name.to_string_lossy();
        let weights = name.starts_with(WEIGHTS_PREFIX) && name.ends_with(WEIGHTS_SUFFIX) && name != current;
        if weights || name.starts_with(TEMPORARY_PREFIX) {
            let path = directory.join(name.as_ref());
            fs::remove_file(&path).map_err(io("delete", &path))?;
        }
    }
    Ok(())
}

fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> CheckpointError {
    let path = path.to_owned();
    move |source| CheckpointError::Io { action, path, source }
}

fn damaged(path: &Path, reason: String) -> CheckpointError {
    CheckpointError::Damaged { path: path.to_owned(), reason }
}

#[cfg(test)]
#[path = "checkpoint_tests.rs"]
mod tests;
