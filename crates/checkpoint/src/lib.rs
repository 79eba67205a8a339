//! Checkpoints: a directory with `checkpoint.json` and the files of arrays that it names, the policy's weights and what
//! the training needs to go on, which only the learner understands.
//!
//! Writing is atomic: the arrays get new names first, then `checkpoint.json`, which names them with their sizes and
//! checksums, is renamed into place, and only then the old arrays are deleted. Whatever moment the program or the
//! machine dies at, the directory holds a complete checkpoint, the old one or the new one.
//!
//! A policy that is only to be tested may also be one file: its weights as safetensors, with the same JSON document in
//! the file's metadata.
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
use perturb_files::{FileError, checksum, has_file, read_if_there, write_atomically};
use perturb_policy::{Inputs, Normalisers, ObservationNormaliser, Player, PolicySpec, RewardNormaliser, Role, Weights};
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

/// Format of the JSON document; raised when older programs could misread it. Format 1 also stores what follows from the
/// configuration. Formats 1 and 2 have no checksum.
const FORMAT_VERSION: u32 = 3;
/// The first format with a checksum.
const SEALED: u32 = 3;
/// Maximum number of times that a checkpoint is read while a training replaces it again and again.
const MAX_LOOKS: u32 = 20;
/// The file that makes a directory a checkpoint.
pub const JSON: &str = "checkpoint.json";
const WEIGHTS_PREFIX: &str = "weights-";
/// Begins the names of files of what resuming needs.
pub const RESUME_PREFIX: &str = "resume-";

/// A trained policy with everything that testing needs.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Everything but the weights.
    pub state: State,
    /// The shape of the policy. If the policy was trained by perturb, it is that of [`State::policy`].
    pub policy: PolicySpec,
    /// The policy's weights, in the order of [`PolicySpec::layout`].
    pub weights: Weights,
}

/// Everything in a checkpoint but the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// The environment at the time of training.
    pub environment_spec: EnvironmentSummary,
    /// The statistics of observations; `None` if they were not normalised.
    pub observation_normaliser: Option<ObservationNormaliser>,
    /// The statistics of rewards; `None` if they were not normalised.
    pub reward_normaliser: Option<RewardNormaliser>,
    /// The progress of the training.
    pub counters: Counters,
    /// The training's configuration, flat, as in `config.toml`.
    pub config: TrainConfig,
    /// The programs that trained, each with its commit, in order and without repetitions; empty in checkpoints of
    /// earlier programs, which did not say.
    #[serde(default)]
    pub commits: Vec<String>,
}

/// The state of a training in addition to its policy, from which it resumes.
#[derive(Clone, Debug)]
pub struct Resume {
    /// The file of arrays, whose name begins with [`RESUME_PREFIX`].
    pub arrays: ArraysFile,
    /// The entry in `checkpoint.json`.
    pub document: serde_json::Value,
}

/// `checkpoint.json`.
#[derive(Serialize, Deserialize)]
struct CheckpointDocument {
    format_version: u32,
    weights: ArraysFile,
    /// The state of the training. Tests do not read it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    resume: Option<serde_json::Value>,
    #[serde(flatten)]
    rest: serde_json::Value,
}

/// Why a checkpoint cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The operating system refused a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// There is no checkpoint.
    #[error(
        "{} holds no checkpoint: expected checkpoint.json there or in its folder checkpoint/; give the --out of a \
         training, or the name of a policy in results/",
        path.display()
    )]
    Missing {
        /// The given path.
        path: PathBuf,
    },
    /// A name is the beginning of several.
    #[error("`{name}` could be any of these policies in {}, give the name or the path of one: {}", folder.display(), names.join(", "))]
    Several {
        /// The given name.
        name: String,
        /// The folder that was searched.
        folder: PathBuf,
        /// The policies whose names match.
        names: Vec<String>,
    },
    /// A file is damaged.
    #[error("{} is not a usable checkpoint: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The fault.
        reason: String,
    },
    /// The file has an unknown format, probably that of a newer program, which can read it.
    #[error(
        "{} has format {format}, and this program reads 1 to {FORMAT_VERSION}: use the version of perturb that wrote it, or \
         an undamaged copy",
        path.display()
    )]
    Newer {
        /// The file.
        path: PathBuf,
        /// The format of the file.
        format: u64,
    },
    /// There is a policy, but not the state of its training.
    #[error(
        "the checkpoint in {} can be tested but not resumed: it holds the policy without the state of its training, as \
         those of earlier versions of perturb; train again with --overwrite",
        path.display()
    )]
    NotResumable {
        /// The directory.
        path: PathBuf,
    },
}

/// A result with a [`CheckpointError`].
pub type Result<T> = std::result::Result<T, CheckpointError>;

impl Checkpoint {
    /// Replaces the checkpoint in `directory`, which is created if it is not there. Without `resume` it can be tested,
    /// but its training cannot be resumed.
    ///
    /// # Errors
    /// [`CheckpointError::File`]; the earlier checkpoint, if any, is then still there.
    pub fn save(&self, directory: &Path, resume: Option<Resume>) -> Result<()> {
        let iterations = self.state.counters.iterations;
        let (resume_file, resume) = resume.map(|Resume { arrays, document }| (arrays.file, document)).unzip();
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

    /// Reads the checkpoint in `path`, in its folder `checkpoint`, or in the file `path`. If there is none, reads the
    /// checkpoint of the cell whose id is `path`, or the only one that begins with `path`, below `results/` or the folder
    /// in the variable `PERTURB_RESULTS`.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the file.
    pub fn load(path: &Path) -> Result<Self> {
        let named = named::find(path)?;
        let path = named.as_deref().unwrap_or(path);
        if single_file::is_policy(path)? {
            return Self::load_file(path);
        }
        CheckpointDocument::read_with(path, Self::from_document)
    }

    /// Reads the checkpoint in `path`, or in its folder `checkpoint`. Returns also the folder in which it was found, and
    /// the document of its training's state.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the file.
    pub fn load_resumable(path: &Path) -> Result<(Self, PathBuf, serde_json::Value)> {
        CheckpointDocument::read_with(path, |directory, mut document| {
            let resume = document.resume.take();
            let checkpoint = Self::from_document(directory, document)?;
            let resume = resume.ok_or_else(|| CheckpointError::NotResumable { path: directory.to_owned() })?;
            Ok((checkpoint, directory.to_owned(), resume))
        })
    }

    /// Reads the policy that `document` in `directory` describes.
    fn from_document(directory: &Path, document: CheckpointDocument) -> Result<Self> {
        let state = State::from_document(directory, document.rest)?;
        let policy = state.policy();
        let bytes = document.weights.read(directory)?;
        let file = document.weights.path(directory);
        let weights = decode_weights(&bytes, &policy).map_err(|reason| damaged(&file, reason))?;
        Ok(Self { state, policy, weights })
    }

    /// Names the policy: the iterations of its training, and a checksum of its weights. Weights of equal trainings have
    /// the same name.
    ///
    /// # Errors
    /// A description of what is wrong with the weights.
    pub fn id(&self) -> std::result::Result<String, String> {
        let weights = encode_weights(&self.weights)?;
        Ok(format!("{:08}-{:08x}", self.state.counters.iterations, crc32c::crc32c(&weights)))
    }

    /// The weights one after the other, in the order of [`PolicySpec::layout`].
    pub fn flat_weights(&self) -> Vec<f32> {
        self.weights.iter().flat_map(|array| array.data.iter().copied()).collect()
    }

    /// The policy as it plays in tests, with sampled actions and frozen statistics, in N = `n_envs` environments whose
    /// indices are `first_environment_index` and so on. `seed` fixes the actions.
    ///
    /// # Errors
    /// Weights that do not fit.
    pub fn player(&self, n_envs: usize, seed: u64, first_environment_index: u32) -> perturb_policy::Result<Player> {
        let Self { state, policy, weights } = self;
        let normalisers = Normalisers {
            observations: state.observation_normaliser.clone(),
            rewards: state.reward_normaliser.clone(),
        };
        let episodes_per_trial = state.config.settings.episodes_per_trial();
        let role = Role::testing(seed, first_environment_index, n_envs);
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
    /// Reads the state of the checkpoint in `path`, or in its folder `checkpoint`. Does not read the weights, but checks
    /// that they are there.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the file.
    pub fn load(path: &Path) -> Result<Self> {
        CheckpointDocument::read_with(path, |directory, document| {
            let state = Self::from_document(directory, document.rest)?;
            document.weights.require(directory)?;
            Ok(state)
        })
    }

    /// Reads the state from the document of `checkpoint.json` in `directory`.
    fn from_document(directory: &Path, document: serde_json::Value) -> Result<Self> {
        let json = directory.join(JSON);
        let state: Self = serde_json::from_value(document)
            .map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        state.check().map_err(|reason| damaged(&json, reason))?;
        Ok(state)
    }

    /// Whether the statistics are those that the configuration asks for; says what is wrong if they are not.
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

    /// Whether `served` is the environment that this was trained in.
    ///
    /// # Errors
    /// [`Changed`], with the first difference.
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

    /// Returns the number of parameters at the end of an observation.
    fn parameters_seen(&self) -> usize {
        if self.config.common.observe.sees_parameters() { self.environment_spec.parameters.len() } else { 0 }
    }

    /// Returns a new normaliser of observations, if they are normalised. Observed parameters are not normalised, since
    /// they are scaled already.
    pub fn fresh_normaliser(&self) -> Option<ObservationNormaliser> {
        let (size, parameters) = (self.environment_spec.observation.len(), self.parameters_seen());
        let fresh = || ObservationNormaliser::new(size.saturating_sub(parameters)).leaving_alone(parameters);
        self.config.common.normalize_observations.then(fresh)
    }

    /// The shape of a policy that this was trained with.
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

    /// Returns the policy's inputs for `n_envs` environments at the start of a trial.
    pub fn inputs(&self, n_envs: usize) -> Inputs {
        let EnvironmentSummary { observation, action, .. } = &self.environment_spec;
        Inputs::new(observation.len(), *action, n_envs, self.config.settings.has_trials())
    }
}

impl CheckpointDocument {
    /// Reads the document with [`CheckpointDocument::read`] and passes it to `take`. A training may have replaced the
    /// checkpoint meanwhile and deleted the arrays that this document names. Then reads the new one.
    fn read_with<T>(path: &Path, mut take: impl FnMut(&Path, Self) -> Result<T>) -> Result<T> {
        let mut last = String::new();
        for _ in 1..MAX_LOOKS {
            let (directory, document) = Self::read(path)?;
            let named = document.weights.file.clone();
            match take(&directory, document) {
                Err(CheckpointError::File(error)) if error.source.kind() == ErrorKind::NotFound && named != last => {
                    last = named;
                }
                taken => return taken,
            }
        }
        let (directory, document) = Self::read(path)?;
        take(&directory, document)
    }

    /// Reads `checkpoint.json` in `path`, or in its folder `checkpoint`. Returns also the folder in which it was found.
    fn read(path: &Path) -> Result<(PathBuf, Self)> {
        let directory = match has_file(&path.join(JSON))? {
            true => path.to_owned(),
            false => path.join("checkpoint"),
        };
        let json = directory.join(JSON);
        let text = if has_file(&json)? { read_if_there(&json)? } else { None };
        let text = text.ok_or_else(|| CheckpointError::Missing { path: path.to_owned() })?;
        Ok((directory, Self::parse(&json, &text)?))
    }

    /// Reads the `text` of the file `path`.
    fn parse(path: &Path, text: &[u8]) -> Result<Self> {
        let not_understood = |error: serde_json::Error| damaged(path, format!("it is not understood: {error}"));
        let mut value: serde_json::Value = serde_json::from_slice(text).map_err(not_understood)?;
        let sealed = checksum::open(&mut value);
        // Another format may have other entries.
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
