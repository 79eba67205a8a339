//! Checkpoints of trainings. A checkpoint is a directory with `checkpoint.json` and the files of arrays that it names.
//! The arrays are the policy's weights, and the state from which the training can resume, which only the learner
//! interprets.
//!
//! Writing is atomic. First the arrays are written to files with new names. Then `checkpoint.json`, which contains
//! their names, sizes and checksums, is renamed into place. Finally the old arrays are deleted. If the program or the
//! machine stops at any moment, the directory holds a complete checkpoint, either the old or the new one.
//!
//! A policy that only has to be tested may also be a single file: its weights as safetensors, with the same JSON
//! document in the file's metadata.
#![forbid(unsafe_code)]

mod arrays;
mod counters;
mod environment;
mod files;
mod named;
mod single_file;

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use perturb_files::checksum::WithChecksum;
use perturb_files::{FileError, checksum, has_file, read_if_exists, write_atomically};
use perturb_policy::{
    Inputs, Normalisers, ObservationNormaliser, Player, PlayerRole, PolicySpec, RewardNormaliser, Weights,
};
use perturb_protocol::proto;
use perturb_settings::{Architecture, TrainConfig};
use serde::{Deserialize, Serialize};

pub use self::arrays::{Array, Arrays, encode};
use self::arrays::{decode_document, decode_weights, encode_policy, encode_weights};
pub use self::counters::Counters;
pub use self::environment::{Changed, EnvironmentSummary, task_remedy};
use self::files::remove_others;
pub use self::files::{ArraysFile, damaged};
pub use self::named::find as find_policy;

/// Format version of the JSON document. Increase it when older programs could misread the document. Format 1 also
/// stores values that follow from the configuration. Formats 1 and 2 have no checksum.
const FORMAT_VERSION: u32 = 3;
/// The first format version with a checksum.
const SEALED: u32 = 3;
/// Maximum number of attempts to read a checkpoint. An attempt fails if a training replaces the checkpoint meanwhile.
const MAX_LOOKS: u32 = 20;
/// The name of the JSON document; a directory that contains it is a checkpoint.
pub const JSON: &str = "checkpoint.json";
const WEIGHTS_PREFIX: &str = "weights-";
/// The prefix of the files of arrays from which a training resumes.
pub const RESUME_PREFIX: &str = "resume-";

/// A trained policy with everything that a test needs.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// The checkpoint's data other than the weights.
    pub state: State,
    /// The shape of the policy's networks. For a policy trained by perturb it equals [`State::policy`].
    pub policy: PolicySpec,
    /// The policy's weights, in the order of [`PolicySpec::layout`].
    pub weights: Weights,
}

/// The data of a checkpoint other than the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// The environment's properties at the time of the training.
    pub environment_spec: EnvironmentSummary,
    /// The normaliser of observations with its statistics; `None` if they are not normalised.
    pub observation_normaliser: Option<ObservationNormaliser>,
    /// The normaliser of rewards with its statistics; `None` if they are not normalised.
    pub reward_normaliser: Option<RewardNormaliser>,
    /// The progress of the training.
    pub counters: Counters,
    /// The configuration of the training, as a flat table like `config.toml`.
    pub config: TrainConfig,
    /// The versions of the programs that trained the policy, each with its commit, in order and without repetitions.
    /// Empty in checkpoints of older programs, which did not store them.
    #[serde(default)]
    pub commits: Vec<String>,
}

/// The state from which a training resumes, in addition to its policy.
#[derive(Clone, Debug)]
pub struct StoredResumeState {
    /// The file of the state's arrays. Its name begins with [`RESUME_PREFIX`].
    pub arrays: ArraysFile,
    /// The entry `resume` of `checkpoint.json`.
    pub document: serde_json::Value,
}

/// The content of `checkpoint.json`.
#[derive(Serialize, Deserialize)]
struct CheckpointDocument {
    format_version: u32,
    weights: ArraysFile,
    /// The state from which the training resumes. Tests do not read it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    resume: Option<serde_json::Value>,
    #[serde(flatten)]
    rest: serde_json::Value,
}

/// A failure to read or write a checkpoint.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The path contains no checkpoint.
    #[error(
        "{} holds no checkpoint: expected checkpoint.json there or in its folder checkpoint/; give the --out of a \
         training, or the name of a policy in results/",
        path.display()
    )]
    Missing {
        /// The path that the user gave.
        path: PathBuf,
    },
    /// The given name is not unique: the ids of several policies begin with it or resemble it.
    #[error("`{name}` could be any of these policies in {}, give the name or the path of one: {}", folder.display(), names.join(", "))]
    Several {
        /// The name that the user gave.
        name: String,
        /// The folder that was searched.
        folder: PathBuf,
        /// The policies whose names match.
        names: Vec<String>,
    },
    /// A file is damaged.
    #[error("{} is not a usable checkpoint: {reason}", path.display())]
    Damaged {
        /// The path of the file.
        path: PathBuf,
        /// A description of the fault.
        reason: String,
    },
    /// The file has an unknown format, probably of a newer program.
    #[error(
        "{} has format {format}, and this program reads 1 to {FORMAT_VERSION}: use the version of perturb that wrote it, or \
         an undamaged copy",
        path.display()
    )]
    Newer {
        /// The path of the file.
        path: PathBuf,
        /// The format of the file.
        format: u64,
    },
    /// The checkpoint contains the policy, but not the state from which its training could resume.
    #[error(
        "the checkpoint in {} can be tested but not resumed: it holds the policy without the state of its training, as \
         those of earlier versions of perturb; train again with --overwrite",
        path.display()
    )]
    NotResumable {
        /// The directory of the checkpoint.
        path: PathBuf,
    },
}

/// A result with [`CheckpointError`] as its error.
pub type Result<T> = std::result::Result<T, CheckpointError>;

impl Checkpoint {
    /// Writes the checkpoint to `directory`, which is created if needed, and replaces an earlier checkpoint. Without
    /// `resume`, the policy can be tested, but its training cannot be resumed.
    ///
    /// # Errors
    /// [`CheckpointError::File`] if a file cannot be written. An earlier checkpoint then still exists.
    pub fn save(&self, directory: &Path, resume: Option<StoredResumeState>) -> Result<()> {
        let iterations = self.state.counters.iterations;
        let (resume_file, resume) =
            resume.map(|StoredResumeState { arrays, document }| (arrays.file, document)).unzip();
        let weights = encode_weights(&self.weights).map_err(|reason| damaged(directory, reason))?;
        let weights = ArraysFile::write(directory, WEIGHTS_PREFIX, iterations, &weights)?;
        let weights_file = weights.file.clone();

        let document = CheckpointDocument {
            format_version: FORMAT_VERSION,
            weights,
            resume,
            rest: serde_json::to_value(&self.state).map_err(|error| damaged(directory, error.to_string()))?,
        };
        let not_written = |error: serde_json::Error| damaged(directory, error.to_string());
        let sealed = WithChecksum::new(&document).map_err(not_written)?;
        let json = serde_json::to_vec_pretty(&sealed).map_err(not_written)?;
        write_atomically(&directory.join(JSON), &json)?;
        let current = [weights_file.as_str(), resume_file.as_deref().unwrap_or_default()];
        Ok(remove_others(directory, &[WEIGHTS_PREFIX, RESUME_PREFIX], &current)?)
    }

    /// Reads a checkpoint. `path` may be its directory, the directory above the folder `checkpoint`, or a policy file.
    /// Otherwise `path` is taken as the id of an experiment's cell (a training with its tests), or as the beginning of
    /// exactly one id. Cells are searched below `results/`, or below the folder in the environment variable
    /// `PERTURB_RESULTS`.
    ///
    /// # Errors
    /// [`CheckpointError`] with the path of the file.
    pub fn load(path: &Path) -> Result<Self> {
        let named = named::find(path)?;
        let path = named.as_deref().unwrap_or(path);
        if single_file::is_policy(path)? {
            return Self::load_file(path);
        }
        CheckpointDocument::read_with(path, Self::from_document)
    }

    /// Reads a checkpoint to resume its training. `path` is its directory, or the directory above the folder
    /// `checkpoint`. Returns the checkpoint, its directory, and the entry `resume` of `checkpoint.json`.
    ///
    /// # Errors
    /// [`CheckpointError`] with the path of the file.
    pub fn load_resumable(path: &Path) -> Result<(Self, PathBuf, serde_json::Value)> {
        CheckpointDocument::read_with(path, |directory, mut document| {
            let resume = document.resume.take();
            let checkpoint = Self::from_document(directory, document)?;
            let resume = resume.ok_or_else(|| CheckpointError::NotResumable { path: directory.to_owned() })?;
            Ok((checkpoint, directory.to_owned(), resume))
        })
    }

    /// Reads the policy that the `document` in `directory` describes.
    fn from_document(directory: &Path, document: CheckpointDocument) -> Result<Self> {
        let state = State::from_document(directory, document.rest)?;
        let policy = state.policy();
        let bytes = document.weights.read(directory)?;
        let file = document.weights.path(directory);
        let weights = decode_weights(&bytes, &policy).map_err(|reason| damaged(&file, reason))?;
        Ok(Self { state, policy, weights })
    }

    /// Returns the id of the policy: the number of iterations of its training, and a checksum of its weights. Policies
    /// with equal weights after the same number of iterations have the same id.
    ///
    /// # Errors
    /// A description of the fault if the weights cannot be encoded.
    pub fn id(&self) -> std::result::Result<String, String> {
        let weights = encode_weights(&self.weights)?;
        Ok(format!("{:08}-{:08x}", self.state.counters.iterations, crc32c::crc32c(&weights)))
    }

    /// Returns all weights as one array, in the order of [`PolicySpec::layout`].
    pub fn flat_weights(&self) -> Vec<f32> {
        self.weights.iter().flat_map(|array| array.data.iter().copied()).collect()
    }

    /// Creates a player that tests the policy, with sampled actions and frozen statistics, in N = `n_envs`
    /// environments. Their environment indices are successive numbers from `first_environment_index`. `seed` determines
    /// the actions.
    ///
    /// # Errors
    /// An error if the weights do not fit the policy.
    pub fn player(&self, n_envs: usize, seed: u64, first_environment_index: u32) -> perturb_policy::Result<Player> {
        let Self { state, policy, weights } = self;
        let normalisers = Normalisers {
            observations: state.observation_normaliser.clone(),
            rewards: state.reward_normaliser.clone(),
        };
        let episodes_per_trial = state.config.settings.episodes_per_trial();
        let role = PlayerRole::testing(seed, first_environment_index, n_envs);
        let mut player = Player::new(policy, state.inputs(n_envs), n_envs, episodes_per_trial, normalisers, role);
        if state.config.settings.is_random() {
            player = player.uniformly();
        }
        policy.check(weights)?;
        player.load(&self.flat_weights())?;
        Ok(player)
    }
}

impl State {
    /// Reads the state of a checkpoint without its weights, but checks that the file of weights exists. `path` is the
    /// checkpoint's directory, or the directory above the folder `checkpoint`.
    ///
    /// # Errors
    /// [`CheckpointError`] with the path of the file.
    pub fn load(path: &Path) -> Result<Self> {
        CheckpointDocument::read_with(path, |directory, document| {
            let state = Self::from_document(directory, document.rest)?;
            document.weights.require(directory)?;
            Ok(state)
        })
    }

    /// Parses the state from the `document` of `checkpoint.json` in `directory`.
    fn from_document(directory: &Path, document: serde_json::Value) -> Result<Self> {
        let json = directory.join(JSON);
        let state: Self = serde_json::from_value(document)
            .map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        state.check().map_err(|reason| damaged(&json, reason))?;
        Ok(state)
    }

    /// Checks that the normalisers fit the configuration and the environment. The error describes the fault.
    fn check(&self) -> std::result::Result<(), String> {
        let (common, gamma) = (&self.config.common, self.config.settings.gamma());
        let observations = match &self.observation_normaliser {
            Some(normaliser) => normaliser.check(self.environment_spec.observation.len(), self.parameters_seen()),
            None if common.normalize_observations => Err("there is none".into()),
            None => Ok(()),
        };
        observations.map_err(|reason| format!("observation_normaliser: {reason}"))?;
        let rewards = match &self.reward_normaliser {
            Some(normaliser) => {
                normaliser.check().and_then(|()| normaliser.fits(common.num_envs, gamma, common.reward_return_runs_on))
            }
            None if common.normalize_rewards => Err("there is none".into()),
            None => Ok(()),
        };
        rewards.map_err(|reason| format!("reward_normaliser: {reason}"))
    }

    /// Checks that `served` is the environment in which the policy was trained.
    ///
    /// # Errors
    /// [`Changed`] with the first difference.
    pub fn check_unchanged(&self, served: &proto::Environment) -> std::result::Result<(), Changed> {
        let trained = &self.environment_spec;
        let (what, trained, served) = match EnvironmentSummary::from_environment(served) {
            None => ("actions", format!("{:?}", trained.action), "none".into()),
            Some(served) => match trained.difference(&served) {
                None => return Ok(()),
                Some(difference) => difference,
            },
        };
        Err(Changed { environment: self.config.common.environment.clone(), what, trained, served })
    }

    /// Returns the number of elements at the end of an observation that are parameters.
    fn parameters_seen(&self) -> usize {
        if self.config.common.observe.sees_parameters() { self.environment_spec.parameters.len() } else { 0 }
    }

    /// Creates a normaliser of observations without statistics, or returns `None` if observations are not normalised.
    /// Observed parameters are not normalised, because they are scaled already.
    pub fn fresh_normaliser(&self) -> Option<ObservationNormaliser> {
        let (size, parameters) = (self.environment_spec.observation.len(), self.parameters_seen());
        let fresh = || ObservationNormaliser::new(size.saturating_sub(parameters)).leaving_alone(parameters);
        self.config.common.normalize_observations.then(fresh)
    }

    /// Returns the shape of the policy that a training with this configuration has.
    pub fn policy(&self) -> PolicySpec {
        if self.config.settings.is_random() {
            let observation_size = self.inputs(1).size();
            return PolicySpec {
                observation_size,
                action: self.environment_spec.action,
                hidden: Vec::new(),
                lstm: None,
            };
        }
        let shape = match self.config.common.architecture {
            Architecture::Ff => PolicySpec::feed_forward,
            Architecture::Rc => PolicySpec::recurrent,
        };
        shape(self.inputs(1).size(), self.environment_spec.action)
    }

    /// Creates the policy's inputs for `n_envs` environments at the start of a trial.
    pub fn inputs(&self, n_envs: usize) -> Inputs {
        let EnvironmentSummary { observation, action, .. } = &self.environment_spec;
        Inputs::new(observation.len(), *action, n_envs, self.config.settings.has_trials())
    }
}

impl CheckpointDocument {
    /// Reads `checkpoint.json` and passes it to `take`, which reads the files that the document names. These files are
    /// missing if a training has replaced the checkpoint meanwhile; this function then reads the new checkpoint.
    fn read_with<T>(path: &Path, mut take: impl FnMut(&Path, Self) -> Result<T>) -> Result<T> {
        let mut last = String::new();
        for _ in 1..MAX_LOOKS {
            let (directory, document) = Self::read(path)?;
            let named = document.weights.file.clone();
            match take(&directory, document) {
                // Reads again if the weights are missing. If the document names the same file as in the previous
                // attempt, the file was deleted and not replaced, so the error is returned.
                Err(CheckpointError::File(error)) if error.source.kind() == ErrorKind::NotFound && named != last => {
                    last = named;
                }
                taken => return taken,
            }
        }
        let (directory, document) = Self::read(path)?;
        take(&directory, document)
    }

    /// Reads `checkpoint.json` in the directory `path`, or in its folder `checkpoint`. Also returns the directory in
    /// which the file was found.
    fn read(path: &Path) -> Result<(PathBuf, Self)> {
        let directory = match has_file(&path.join(JSON))? {
            true => path.to_owned(),
            false => path.join("checkpoint"),
        };
        let json = directory.join(JSON);
        let text = if has_file(&json)? { read_if_exists(&json)? } else { None };
        let text = text.ok_or_else(|| CheckpointError::Missing { path: path.to_owned() })?;
        Ok((directory, Self::parse(&json, &text)?))
    }

    /// Parses the `text` of the file at `path`, and checks its format and checksum.
    fn parse(path: &Path, text: &[u8]) -> Result<Self> {
        let not_understood = |error: serde_json::Error| damaged(path, format!("it is not understood: {error}"));
        let mut value: serde_json::Value = serde_json::from_slice(text).map_err(not_understood)?;
        let sealed = checksum::open(&mut value);
        // The format is checked first, because documents of other formats may have other entries.
        let format = value.get("format_version").and_then(serde_json::Value::as_u64);
        if let Some(format) = format.filter(|format| !(1..=u64::from(FORMAT_VERSION)).contains(format)) {
            return Err(CheckpointError::Newer { path: path.to_owned(), format });
        }
        let document: Self = serde_json::from_value(value).map_err(not_understood)?;
        if sealed.is_err() || (document.format_version >= SEALED && sealed == Ok(false)) {
            return Err(damaged(path, format!("{}; use an undamaged copy", checksum::CHECKSUM_MISMATCH)));
        }
        Ok(document)
    }
}

#[cfg(test)]
mod tests;
