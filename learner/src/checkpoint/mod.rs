//! Checkpoints: a directory with `checkpoint.json` and the files of arrays that it names, the policy's weights and what
//! the training needs to go on.
//!
//! Writing is atomic: the arrays get new names first, then `checkpoint.json`, which names them with their sizes and
//! checksums, is renamed into place, and only then the old arrays are deleted. Whatever moment the program or the
//! machine dies at, the directory holds a complete checkpoint, the old one or the new one.

mod arrays;
mod files;
mod resume;

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use self::arrays::{decode_weights, encode_weights};
use self::files::{ArraysFile, damaged, remove_others};
pub use self::resume::{History, ResumeState};
use crate::proto;
use perturb_policy::{ActionKind, Inputs, ObservationNormaliser, PolicySpec, RewardNormaliser, Weights};
use perturb_study::Counters;
use perturb_study::files::{FileError, write_atomically};
use perturb_study::settings::{Architecture, TrainConfig};

/// Of the JSON's layout; raised when older programs could misread it. Format 1 says beside the configuration what follows
/// from it.
const FORMAT_VERSION: u32 = 2;
const JSON: &str = "checkpoint.json";
const WEIGHTS_PREFIX: &str = "weights-";

/// A trained policy with everything that testing needs; what resuming needs beside it is [`ResumeState`].
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Everything but the weights.
    pub state: State,
    /// The shape of the policy; that of [`State::policy`] if it was trained.
    pub policy: PolicySpec,
    /// The policy's weights, in the order of [`PolicySpec::layout`].
    pub weights: Weights,
}

/// Everything in a checkpoint but the weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// What the environment was like.
    pub environment_spec: EnvironmentSummary,
    /// The statistics of observations; `None` if they were not normalised.
    pub observation_normaliser: Option<ObservationNormaliser>,
    /// The statistics of rewards; `None` if they were not normalised.
    pub reward_normaliser: Option<RewardNormaliser>,
    /// How far the training had come.
    pub counters: Counters,
    /// The training's configuration, flat, as in `config.toml`.
    pub config: TrainConfig,
    /// The programs that trained, each with its commit, in order and without repetitions; empty in checkpoints of
    /// earlier programs, which did not say.
    #[serde(default)]
    pub commits: Vec<String>,
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
    /// Names of the quantities that receipts read back; empty in checkpoints of programs that did not keep them.
    #[serde(default)]
    pub applied: Vec<String>,
    /// SHA-256 of the model; empty without one.
    pub model_hash: String,
}

/// `checkpoint.json`.
#[derive(Serialize, Deserialize)]
struct Document {
    format_version: u32,
    weights: ArraysFile,
    /// Not looked into for testing.
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

type Result<T> = std::result::Result<T, CheckpointError>;

impl Checkpoint {
    /// Replaces the checkpoint in `directory`, which is created if it is not there. Without `resume` it can be tested,
    /// but its training cannot be resumed.
    ///
    /// # Errors
    /// [`CheckpointError::File`]; the earlier checkpoint, if any, is then still there.
    pub fn save(&self, directory: &Path, resume: Option<&ResumeState>) -> Result<()> {
        let iterations = self.state.counters.iterations;
        let resume = resume.map(|resume| resume.write(directory, iterations)).transpose()?;
        let (resume_file, resume) = resume.unzip();
        let weights = encode_weights(&self.weights).map_err(|reason| damaged(directory, reason))?;
        let weights = ArraysFile::write(directory, WEIGHTS_PREFIX, iterations, &weights)?;
        let weights_file = weights.file.clone();

        let document = Document {
            format_version: FORMAT_VERSION,
            weights,
            resume,
            rest: serde_json::to_value(&self.state).map_err(|error| damaged(directory, error.to_string()))?,
        };
        let json = serde_json::to_vec_pretty(&document).map_err(|error| damaged(directory, error.to_string()))?;
        write_atomically(&directory.join(JSON), &json)?;
        let current = [weights_file.as_str(), resume_file.as_deref().unwrap_or_default()];
        Ok(remove_others(directory, &[WEIGHTS_PREFIX, resume::PREFIX], &current)?)
    }

    /// Reads the checkpoint in `path`, or in its folder `checkpoint`.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the file.
    pub fn load(path: &Path) -> Result<Self> {
        let (directory, document) = Document::read(path)?;
        Self::of(&directory, document)
    }

    /// Reads the checkpoint in `path`, or in its folder `checkpoint`, with the state of its training.
    ///
    /// # Errors
    /// [`CheckpointError`], which names the file.
    pub fn load_with_resume(path: &Path) -> Result<(Self, ResumeState)> {
        let (directory, mut document) = Document::read(path)?;
        let resume = document.resume.take();
        let checkpoint = Self::of(&directory, document)?;
        let resume = resume.ok_or_else(|| CheckpointError::NotResumable { path: directory.clone() })?;
        Ok((checkpoint, ResumeState::read(&directory, resume)?))
    }

    /// What `document` in `directory` describes.
    fn of(directory: &Path, document: Document) -> Result<Self> {
        let json = directory.join(JSON);
        let state: State = serde_json::from_value(document.rest)
            .map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        state.check().map_err(|reason| damaged(&json, reason))?;
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
    /// What is wrong with the weights.
    pub fn id(&self) -> std::result::Result<String, String> {
        let weights = encode_weights(&self.weights)?;
        Ok(format!("{:08}-{:08x}", self.state.counters.iterations, crc32c::crc32c(&weights)))
    }
}

impl State {
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

    /// How many entries at the end of an observation are parameters.
    fn parameters_seen(&self) -> usize {
        if self.config.common.observe.sees_parameters() { self.environment_spec.parameters.len() } else { 0 }
    }

    /// What normalises observations in training from its beginning, if they are normalised. Parameters that are seen
    /// are scaled already.
    pub(crate) fn fresh_normaliser(&self) -> Option<ObservationNormaliser> {
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

    /// What the policy gets to see of `n_envs` environments at the start of a trial.
    pub fn inputs(&self, n_envs: usize) -> Inputs {
        let EnvironmentSummary { observation, action, .. } = &self.environment_spec;
        Inputs::new(observation.len(), *action, n_envs, self.config.settings.has_trials())
    }
}

impl Document {
    /// Reads `checkpoint.json` in `path`, or in its folder `checkpoint`; gives the folder, too.
    fn read(path: &Path) -> Result<(PathBuf, Self)> {
        let directory = [path.to_owned(), path.join("checkpoint")]
            .into_iter()
            .find(|directory| directory.join(JSON).is_file())
            .ok_or_else(|| CheckpointError::Missing { path: path.to_owned() })?;
        let json = directory.join(JSON);
        let text = perturb_study::files::read(&json)?;
        let document: Document =
            serde_json::from_slice(&text).map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        if !(1..=FORMAT_VERSION).contains(&document.format_version) {
            let reason = format!("it has format {}, this program reads 1 to {FORMAT_VERSION}", document.format_version);
            return Err(damaged(&json, reason));
        }
        Ok((directory, document))
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
            applied: environment.applied.iter().map(|quantity| quantity.name.clone()).collect(),
            model_hash: environment.model_hash.clone(),
        })
    }

    /// The first part in which `served` is not what this says, with both values; `None` if they are equal.
    pub fn difference(&self, served: &Self) -> Option<(&'static str, String, String)> {
        let both = |what, trained: &dyn fmt::Debug, served: &dyn fmt::Debug| {
            Some((what, format!("{trained:?}"), format!("{served:?}")))
        };
        match (self, served) {
            (a, b) if a.revision != b.revision => both("revision", &a.revision, &b.revision),
            (a, b) if a.model_hash != b.model_hash => both("model", &a.model_hash, &b.model_hash),
            (a, b) if a.observation != b.observation => both("observations", &a.observation, &b.observation),
            (a, b) if a.action != b.action => both("actions", &a.action, &b.action),
            (a, b) if a.parameters != b.parameters => both("parameters", &a.parameters, &b.parameters),
            (a, b) if a.step_limit != b.step_limit => both("step limit", &a.step_limit, &b.step_limit),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
