//! The settings of an algorithm: those of what updates the policy, and those of what is wrapped around it.

use serde::Serialize;
use toml::Table;

use super::{A2cConfig, Architecture, ConfigError, EpoptConfig, PpoConfig, Rl2Config};
use crate::value_error::{ValueError, require};

/// Settings of the base algorithm that EPOpt does not use: its iterations consist of complete episodes in one batch.
const NOT_WITH_EPISODES: [&str; 2] = ["n_steps", "n_minibatches"];

/// Maximal number of samples in a rollout, which take some gigabytes.
const MAX_SAMPLES: u128 = 1 << 26;

/// Minimal number of steps of each environment in a long rollout. With fewer, sending a policy's weights takes longer than
/// sending the observations and actions of several trainings together.
const LONG_ROLLOUT: usize = 64;

/// The settings of an algorithm, which say which one it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// The algorithm that updates the policy.
    pub base: Base,
    /// The algorithm around the base algorithm.
    pub wrapper: Wrapper,
}

/// An algorithm that updates the policy.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Base {
    /// Advantage actor-critic.
    A2c(A2cConfig),
    /// Proximal policy optimisation.
    Ppo(PpoConfig),
    /// A random policy, which learns nothing: all actions are equally likely. Serves as a baseline.
    Random,
}

/// An algorithm around a base algorithm.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Wrapper {
    /// No wrapper.
    Plain,
    /// EPOpt: learning from the worst of many episodes.
    Epopt(EpoptConfig),
    /// RL²: trials of several episodes.
    Rl2(Rl2Config),
}

/// The way in which rollouts are collected. Trainings in one batch must collect alike.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CollectionMode {
    /// No rollouts: a random policy learns nothing.
    None,
    /// Few steps. Several trainings share the messages.
    Short,
    /// Many steps, or complete episodes. The server can be sent the weights for each rollout.
    Long,
    /// Rollouts with noise on observations, which the learner adds when it chooses actions.
    Noisy,
}

impl Settings {
    /// All algorithms, each part with its own defaults, in the order in which they are listed.
    pub fn all() -> [Self; 7] {
        let (a2c, ppo) = (|| Base::A2c(A2cConfig::default()), || Base::Ppo(PpoConfig::default()));
        let epopt = || Wrapper::Epopt(EpoptConfig::default());
        let rl2 = || Wrapper::Rl2(Rl2Config::default());
        [
            (Wrapper::Plain, a2c()),
            (Wrapper::Plain, ppo()),
            (epopt(), a2c()),
            (epopt(), ppo()),
            (rl2(), a2c()),
            (rl2(), ppo()),
            (Wrapper::Plain, Base::Random),
        ]
        .map(|(wrapper, base)| Self { base, wrapper })
    }

    /// The names of all algorithms.
    pub fn names() -> [&'static str; 7] {
        Self::all().map(|settings| settings.name())
    }

    /// Returns how rollouts are collected.
    pub(super) fn rollouts(&self) -> CollectionMode {
        let n_steps = match (&self.wrapper, &self.base) {
            (_, Base::Random) => return CollectionMode::None,
            (Wrapper::Epopt(_), _) => return CollectionMode::Long,
            (_, Base::A2c(a2c)) => a2c.n_steps,
            (_, Base::Ppo(ppo)) => ppo.n_steps,
        };
        if n_steps < LONG_ROLLOUT { CollectionMode::Short } else { CollectionMode::Long }
    }

    /// Returns the algorithm's name in settings and options.
    pub fn name(&self) -> &'static str {
        match (&self.wrapper, &self.base) {
            (_, Base::Random) => "random",
            (Wrapper::Plain, Base::A2c(_)) => "a2c",
            (Wrapper::Plain, Base::Ppo(_)) => "ppo",
            (Wrapper::Epopt(_), Base::A2c(_)) => "epopt-a2c",
            (Wrapper::Epopt(_), Base::Ppo(_)) => "epopt-ppo",
            (Wrapper::Rl2(_), Base::A2c(_)) => "rl2-a2c",
            (Wrapper::Rl2(_), Base::Ppo(_)) => "rl2-ppo",
        }
    }

    /// Whether the policy learns nothing.
    pub fn is_random(&self) -> bool {
        matches!(self.base, Base::Random)
    }

    /// Whether the policy learns over trials.
    pub fn has_trials(&self) -> bool {
        matches!(self.wrapper, Wrapper::Rl2(_))
    }

    /// The architecture that is trained if none is named. A policy that learns over trials needs a memory.
    pub(super) fn default_architecture(&self) -> Architecture {
        if self.has_trials() { Architecture::Rc } else { Architecture::Ff }
    }

    /// The settings as a flat table.
    pub(super) fn table(&self) -> Table {
        // Serialisation of plain numbers, booleans and names cannot fail.
        let mut table = Table::try_from(&self.base).unwrap_or_default();
        if let Wrapper::Epopt(_) = self.wrapper {
            table.retain(|key, _| !NOT_WITH_EPISODES.contains(&key));
        }
        table.extend(Table::try_from(&self.wrapper).unwrap_or_default()); // nothing is no table
        table
    }

    /// The settings of this algorithm in `table`, where they stand among others.
    pub(super) fn read(&self, table: &Table) -> Result<Self, toml::de::Error> {
        let table = || table.clone();
        Ok(Self {
            base: match self.base {
                Base::A2c(_) => Base::A2c(table().try_into()?),
                Base::Ppo(_) => Base::Ppo(table().try_into()?),
                Base::Random => Base::Random,
            },
            wrapper: match self.wrapper {
                Wrapper::Plain => Wrapper::Plain,
                Wrapper::Epopt(_) => Wrapper::Epopt(table().try_into()?),
                Wrapper::Rl2(_) => Wrapper::Rl2(table().try_into()?),
            },
        })
    }

    /// γ, per step; 1 for a random policy.
    pub fn gamma(&self) -> f64 {
        match &self.base {
            Base::A2c(settings) => settings.gamma,
            Base::Ppo(settings) => settings.gamma,
            Base::Random => 1.0,
        }
    }

    /// Episodes in a trial; 1 without trials.
    pub fn episodes_per_trial(&self) -> u32 {
        match &self.wrapper {
            Wrapper::Rl2(settings) => settings.episodes_per_trial,
            Wrapper::Plain | Wrapper::Epopt(_) => 1,
        }
    }

    /// Refuses values outside their ranges, and values that contradict each other.
    pub(super) fn validate(&self, architecture: Architecture, num_envs: usize) -> Result<(), ConfigError> {
        match &self.base {
            Base::A2c(settings) => {
                settings.validate()?;
                check_size(settings.n_steps, num_envs)?;
            }
            Base::Ppo(settings) => {
                settings.validate()?;
                check_size(settings.n_steps, num_envs)?;
                check_minibatches(settings, architecture, num_envs)?;
            }
            Base::Random => {
                let expected = "\"ff\": a random policy has nothing to remember";
                require(architecture == Architecture::Ff, "architecture", architecture, expected)?;
            }
        }
        match &self.wrapper {
            Wrapper::Plain => Ok(()),
            Wrapper::Rl2(settings) => Ok(settings.validate()?),
            Wrapper::Epopt(settings) => {
                settings.validate()?;
                let most = settings.episodes_per_iteration;
                let expected = format!("at most episodes_per_iteration, {most}: the others would have nothing to do");
                Ok(require(num_envs <= most, "num_envs", num_envs, expected)?)
            }
        }
    }
}

/// Checks that a machine can hold the rollout.
fn check_size(n_steps: usize, num_envs: usize) -> Result<(), ValueError> {
    let fits = n_steps as u128 * num_envs as u128 <= MAX_SAMPLES;
    let expected = format!("at most {} with {num_envs} environments", MAX_SAMPLES / num_envs as u128);
    require(fits, "n_steps", n_steps, expected)
}

/// Checks that a pass over a rollout can be cut into equal minibatches.
fn check_minibatches(settings: &PpoConfig, architecture: Architecture, num_envs: usize) -> Result<(), ValueError> {
    let PpoConfig { n_steps, n_minibatches, .. } = *settings;
    let (whole, count) = match architecture {
        Architecture::Ff => ("n_steps · num_envs,", n_steps as u128 * num_envs as u128),
        Architecture::Rc => ("num_envs, because a recurrent policy learns from whole environments,", num_envs as u128),
    };
    let parts = count.is_multiple_of(n_minibatches as u128);
    require(parts, "n_minibatches", n_minibatches, format!("a divisor of {whole} which is {count}"))
}
