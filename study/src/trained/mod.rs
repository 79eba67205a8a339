//! Policies that were trained, as they act: what of a checkpoint is needed to play with it, for those who cannot learn.
//!
//! The learner writes checkpoints, and says how: a folder with `checkpoint.json`, which names the file of the weights with
//! its size and checksum, and has the statistics and the configuration.

mod weights;

#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use perturb_policy::{
    ActionKind, Inputs, Normalisers, ObservationNormaliser, Player, PolicySpec, RewardNormaliser, Role, Weights,
};
use perturb_protocol::proto;
use serde::{Deserialize, Serialize};

use crate::Counters;
use crate::files::{self, FileError};
use crate::settings::{Architecture, TrainConfig};

/// The latest layout of the JSON that is understood.
const FORMAT_VERSION: u32 = 2;
const JSON: &str = "checkpoint.json";

/// A trained policy, with everything that testing it needs.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainedPolicy {
    /// Everything but the weights.
    pub state: TrainedState,
    /// The shape of the policy.
    pub spec: PolicySpec,
    /// The policy's weights, in the order of [`PolicySpec::layout`].
    pub weights: Weights,
}

/// What `checkpoint.json` has of a policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainedState {
    /// What the environment was like.
    pub environment_spec: EnvironmentSeen,
    /// The statistics of observations; `None` if they were not normalised.
    pub observation_normaliser: Option<ObservationNormaliser>,
    /// The statistics of rewards; `None` if they were not normalised.
    pub reward_normaliser: Option<RewardNormaliser>,
    /// How far the training had come.
    pub counters: Counters,
    /// The training's configuration.
    pub config: TrainConfig,
}

/// What an environment must still be for a policy to fit it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSeen {
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

/// `checkpoint.json`; what resuming needs is passed over.
#[derive(Deserialize)]
struct Document {
    format_version: u32,
    weights: weights::WeightsFile,
    #[serde(flatten)]
    state: serde_json::Value,
}

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum TrainedError {
    /// The operating system refused a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// There is no checkpoint.
    #[error(
        "{} holds no checkpoint: expected checkpoint.json there or in its folder checkpoint/; give the --out of a \
         training",
        path.display()
    )]
    Missing { path: PathBuf },
    /// A file is damaged, or was written by a program that is too different.
    #[error("{} is not a usable checkpoint: {reason}", path.display())]
    Damaged {
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

impl TrainedPolicy {
    /// Reads the checkpoint in `path`, or in its folder `checkpoint`.
    ///
    /// # Errors
    /// [`TrainedError`], which names the file.
    pub fn load(path: &Path) -> Result<Self, TrainedError> {
        let directory = [path.to_owned(), path.join("checkpoint")]
            .into_iter()
            .find(|directory| directory.join(JSON).is_file())
            .ok_or_else(|| TrainedError::Missing { path: path.to_owned() })?;
        let json = directory.join(JSON);
        let damaged = |path: &Path, reason: String| TrainedError::Damaged { path: path.to_owned(), reason };
        let document: Document = serde_json::from_slice(&files::read(&json)?)
            .map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        if !(1..=FORMAT_VERSION).contains(&document.format_version) {
            let reason = format!("it has format {}, this program reads 1 to {FORMAT_VERSION}", document.format_version);
            return Err(damaged(&json, reason));
        }
        let state: TrainedState = serde_json::from_value(document.state)
            .map_err(|error| damaged(&json, format!("it is not understood: {error}")))?;
        state.check().map_err(|reason| damaged(&json, reason))?;
        let file = document.weights.path(&directory);
        let spec = state.policy();
        let weights = document.weights.read(&directory)?;
        let weights = weights.and_then(|bytes| weights::decode(&bytes, &spec));
        Ok(Self { state, weights: weights.map_err(|reason| damaged(&file, reason))?, spec })
    }

    /// Names the policy: the iterations of its training, and a checksum of its weights. Weights of equal trainings have
    /// the same name.
    ///
    /// # Errors
    /// What is wrong with the weights.
    pub fn id(&self) -> Result<String, String> {
        Ok(format!("{:08}-{:08x}", self.state.counters.iterations, crc32c::crc32c(&weights::encode(&self.weights)?)))
    }

    /// The policy as it plays in tests, with sampled actions and frozen statistics, in N = `n_envs` environments whose
    /// indices are `first_environment_index` and so on. `seed` fixes the actions.
    ///
    /// # Errors
    /// Weights that do not fit.
    pub fn player(&self, n_envs: usize, seed: u64, first_environment_index: u32) -> perturb_policy::Result<Player> {
        let TrainedState { observation_normaliser, reward_normaliser, config, .. } = &self.state;
        let normalisers =
            Normalisers { observations: observation_normaliser.clone(), rewards: reward_normaliser.clone() };
        let trials = config.settings.episodes_per_trial();
        let role = Role::testing(seed, first_environment_index, n_envs);
        let mut player = Player::new(&self.spec, self.state.inputs(n_envs), n_envs, trials, normalisers, role);
        if config.settings.is_random() {
            player = player.uniformly();
        }
        self.spec.check(&self.weights)?;
        player.load(&self.weights.iter().flat_map(|array| array.data.iter().copied()).collect::<Vec<f32>>())?;
        Ok(player)
    }
}

impl TrainedState {
    /// Whether the statistics are those that the configuration asks for; says what is wrong if they are not.
    fn check(&self) -> Result<(), String> {
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

    /// The shape of a policy that this was trained with.
    fn policy(&self) -> PolicySpec {
        let (observation_size, action) = (self.inputs(1).size(), self.environment_spec.action);
        if self.config.settings.is_random() {
            return PolicySpec { observation_size, action, hidden: Vec::new(), lstm: None };
        }
        match self.config.common.architecture {
            Architecture::Ff => PolicySpec::feed_forward(observation_size, action),
            Architecture::Rc => PolicySpec::recurrent(observation_size, action),
        }
    }

    /// What the policy gets to see of `n_envs` environments at the start of a trial.
    fn inputs(&self, n_envs: usize) -> Inputs {
        let EnvironmentSeen { observation, action, .. } = &self.environment_spec;
        Inputs::new(observation.len(), *action, n_envs, self.config.settings.has_trials())
    }
}

impl EnvironmentSeen {
    /// Of an environment; `None` if its action space is not given.
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
        let (a, b) = (self, served);
        let parts = [
            ("revision", a.revision == b.revision, format!("{:?}", a.revision), format!("{:?}", b.revision)),
            ("model", a.model_hash == b.model_hash, format!("{:?}", a.model_hash), format!("{:?}", b.model_hash)),
            (
                "observations",
                a.observation == b.observation,
                format!("{:?}", a.observation),
                format!("{:?}", b.observation),
            ),
            ("actions", a.action == b.action, format!("{:?}", a.action), format!("{:?}", b.action)),
            ("parameters", a.parameters == b.parameters, format!("{:?}", a.parameters), format!("{:?}", b.parameters)),
            ("step limit", a.step_limit == b.step_limit, format!("{:?}", a.step_limit), format!("{:?}", b.step_limit)),
        ];
        parts.into_iter().find(|part| !part.1).map(|(what, _, trained, served)| (what, trained, served))
    }
}
