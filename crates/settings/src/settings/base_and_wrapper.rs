//! The settings of an algorithm. An algorithm consists of a base algorithm, which updates the policy, and optionally of
//! a wrapper around it.

use serde::Serialize;
use toml::Table;

use super::{A2cConfig, Architecture, ConfigError, EpoptConfig, PpoConfig, Rl2Config};
use crate::value_error::{ValueError, require};

/// Settings of base algorithms that do not exist with EPOpt, because each iteration of EPOpt learns from complete
/// episodes in one batch.
const NOT_WITH_EPISODES: [&str; 2] = ["n_steps", "n_minibatches"];

/// Maximal number of samples in a rollout. That many samples take some gigabytes.
const MAX_SAMPLES: u128 = 1 << 26;

/// Minimal number of steps of each environment in a rollout that counts as long. For shorter rollouts, sending the
/// policy's weights to the server takes longer than sending observations and actions in messages that several trainings
/// share.
const LONG_ROLLOUT: usize = 64;

/// The settings of an algorithm. The variants of both fields determine the algorithm.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// The algorithm that updates the policy.
    pub base: Base,
    /// The wrapper around the base algorithm.
    pub wrapper: Wrapper,
}

/// A base algorithm, which updates the policy, with its settings.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Base {
    /// A2C, advantage actor-critic.
    A2c(A2cConfig),
    /// PPO, proximal policy optimisation.
    Ppo(PpoConfig),
    /// No learning: a random policy whose actions are all equally likely. It serves as a baseline.
    Random,
    /// No learning: a policy with a rule that was written by hand for the environment. It serves as a baseline.
    Heuristic,
}

/// A wrapper, which changes the episodes that a base algorithm learns from, with its settings.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Wrapper {
    /// No wrapper.
    Plain,
    /// EPOpt, which learns from the worst of many episodes.
    Epopt(EpoptConfig),
    /// RL², which learns over trials of several episodes.
    Rl2(Rl2Config),
}

/// The way in which a training collects rollouts. Trainings whose environments share a batch must have the same mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CollectionMode {
    /// The training collects no rollouts, because the policy learns nothing.
    None,
    /// Rollouts have few steps. Several trainings share a session, so that one message carries the steps of all of
    /// them.
    Short,
    /// Rollouts have many steps, or complete episodes. The server can choose the actions if it gets the weights for
    /// each rollout.
    Long,
    /// Rollouts have noise on observations. The learner chooses the actions, because it adds the noise.
    Noisy,
}

impl Settings {
    /// Returns all algorithms with their default settings, in the order in which users see them.
    pub fn all() -> [Self; 8] {
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
            (Wrapper::Plain, Base::Heuristic),
        ]
        .map(|(wrapper, base)| Self { base, wrapper })
    }

    /// Returns the names of all algorithms.
    pub fn names() -> [&'static str; 8] {
        Self::all().map(|settings| settings.name())
    }

    /// Returns how rollouts are collected if no noise is added to observations.
    pub(super) fn rollouts(&self) -> CollectionMode {
        let n_steps = match (&self.wrapper, &self.base) {
            (_, Base::Random | Base::Heuristic) => return CollectionMode::None,
            (Wrapper::Epopt(_), _) => return CollectionMode::Long,
            (_, Base::A2c(a2c)) => a2c.n_steps,
            (_, Base::Ppo(ppo)) => ppo.n_steps,
        };
        if n_steps < LONG_ROLLOUT { CollectionMode::Short } else { CollectionMode::Long }
    }

    /// Returns the algorithm's name in settings and on the command line.
    pub fn name(&self) -> &'static str {
        match (&self.wrapper, &self.base) {
            (_, Base::Random) => "random",
            (_, Base::Heuristic) => "heuristic",
            (Wrapper::Plain, Base::A2c(_)) => "a2c",
            (Wrapper::Plain, Base::Ppo(_)) => "ppo",
            (Wrapper::Epopt(_), Base::A2c(_)) => "epopt-a2c",
            (Wrapper::Epopt(_), Base::Ppo(_)) => "epopt-ppo",
            (Wrapper::Rl2(_), Base::A2c(_)) => "rl2-a2c",
            (Wrapper::Rl2(_), Base::Ppo(_)) => "rl2-ppo",
        }
    }

    /// Returns whether the policy acts at random.
    pub fn is_random(&self) -> bool {
        matches!(self.base, Base::Random)
    }

    /// Returns whether the policy learns. Otherwise it is made without a training.
    pub fn learns(&self) -> bool {
        !matches!(self.base, Base::Random | Base::Heuristic)
    }

    /// Returns whether the policy learns over trials of several episodes (RL²).
    pub fn has_trials(&self) -> bool {
        matches!(self.wrapper, Wrapper::Rl2(_))
    }

    /// Returns the default architecture: recurrent for RL², which needs a memory, otherwise feed-forward.
    pub(super) fn default_architecture(&self) -> Architecture {
        if self.has_trials() { Architecture::Rc } else { Architecture::Ff }
    }

    /// Returns the settings as a flat table, without a distinction of base and wrapper.
    pub(super) fn table(&self) -> Table {
        // Serialisation of plain numbers, booleans and names cannot fail.
        let mut table = Table::try_from(&self.base).unwrap_or_default();
        if let Wrapper::Epopt(_) = self.wrapper {
            table.retain(|key, _| !NOT_WITH_EPISODES.contains(&key));
        }
        // Without a wrapper, the conversion fails and adds no settings.
        table.extend(Table::try_from(&self.wrapper).unwrap_or_default());
        table
    }

    /// Reads the settings of this algorithm from `table`, which may also contain other settings.
    pub(super) fn read(&self, table: &Table) -> Result<Self, toml::de::Error> {
        let table = || table.clone();
        Ok(Self {
            base: match self.base {
                Base::A2c(_) => Base::A2c(table().try_into()?),
                Base::Ppo(_) => Base::Ppo(table().try_into()?),
                Base::Random => Base::Random,
                Base::Heuristic => Base::Heuristic,
            },
            wrapper: match self.wrapper {
                Wrapper::Plain => Wrapper::Plain,
                Wrapper::Epopt(_) => Wrapper::Epopt(table().try_into()?),
                Wrapper::Rl2(_) => Wrapper::Rl2(table().try_into()?),
            },
        })
    }

    /// Returns the discount factor γ per step; 1 for a policy that does not learn.
    pub fn gamma(&self) -> f64 {
        match &self.base {
            Base::A2c(settings) => settings.gamma,
            Base::Ppo(settings) => settings.gamma,
            Base::Random | Base::Heuristic => 1.0,
        }
    }

    /// Returns the number of episodes in a trial; 1 if the algorithm has no trials.
    pub fn episodes_per_trial(&self) -> u32 {
        match &self.wrapper {
            Wrapper::Rl2(settings) => settings.episodes_per_trial,
            Wrapper::Plain | Wrapper::Epopt(_) => 1,
        }
    }

    /// Checks that all values are in their ranges and do not contradict each other.
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
            Base::Random | Base::Heuristic => {
                let expected = format!("\"ff\": a {} policy has nothing to remember", self.name());
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

/// Checks that a rollout fits into the memory of a usual machine.
fn check_size(n_steps: usize, num_envs: usize) -> Result<(), ValueError> {
    let fits = n_steps as u128 * num_envs as u128 <= MAX_SAMPLES;
    let expected = format!("at most {} with {num_envs} environments", MAX_SAMPLES / num_envs as u128);
    require(fits, "n_steps", n_steps, expected)
}

/// Checks that a rollout can be divided into equal minibatches.
fn check_minibatches(settings: &PpoConfig, architecture: Architecture, num_envs: usize) -> Result<(), ValueError> {
    let PpoConfig { n_steps, n_minibatches, .. } = *settings;
    let (whole, count) = match architecture {
        Architecture::Ff => ("n_steps · num_envs,", n_steps as u128 * num_envs as u128),
        Architecture::Rc => ("num_envs, because a recurrent policy learns from whole environments,", num_envs as u128),
    };
    let parts = count.is_multiple_of(n_minibatches as u128);
    require(parts, "n_minibatches", n_minibatches, format!("a divisor of {whole} which is {count}"))
}
