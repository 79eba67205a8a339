//! The settings of an algorithm: those of what updates the policy, and those of what is wrapped around it.

use toml::Table;

use super::{A2cConfig, EpoptConfig, PpoConfig, Rl2Config};
use super::{AlgorithmName, Architecture, Base, ConfigError, Wrapper};

/// What EPOpt's base has no use for: an iteration is complete episodes, and one batch.
const NOT_WITH_EPISODES: [&str; 2] = ["n_steps", "n_minibatches"];

/// The most samples of a rollout: some gigabytes.
const MOST_SAMPLES: u128 = 1 << 26;

/// The settings of an algorithm.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Of what updates the policy.
    pub base: BaseSettings,
    /// Of what is wrapped around it.
    pub wrapper: WrapperSettings,
}

/// The settings of what updates the policy.
#[derive(Clone, Debug, PartialEq)]
pub enum BaseSettings {
    /// Of A2C.
    A2c(A2cConfig),
    /// Of PPO.
    Ppo(PpoConfig),
}

/// The settings of what is wrapped around it.
#[derive(Clone, Debug, PartialEq)]
pub enum WrapperSettings {
    /// There is nothing.
    Plain,
    /// Of EPOpt.
    Epopt(EpoptConfig),
    /// Of RL².
    Rl2(Rl2Config),
}

impl Settings {
    /// The settings as a flat table.
    pub(super) fn table(&self) -> Table {
        // Serialisation of plain numbers, booleans and names cannot fail.
        let to_table = |value: Result<Table, toml::ser::Error>| value.unwrap_or_default();
        let mut table = match &self.base {
            BaseSettings::A2c(settings) => to_table(Table::try_from(settings)),
            BaseSettings::Ppo(settings) => to_table(Table::try_from(settings)),
        };
        match &self.wrapper {
            WrapperSettings::Plain => {}
            WrapperSettings::Epopt(settings) => {
                table.retain(|key, _| !NOT_WITH_EPISODES.contains(&key));
                table.extend(to_table(Table::try_from(settings)));
            }
            WrapperSettings::Rl2(settings) => table.extend(to_table(Table::try_from(settings))),
        }
        table
    }

    /// Takes the settings of `algorithm` with `architecture` out of `merged`, where they stand among others.
    pub(super) fn take(
        algorithm: AlgorithmName,
        architecture: Architecture,
        merged: &mut Table,
    ) -> Result<Self, toml::de::Error> {
        let defaults = super::defaults::settings(algorithm, architecture);
        let mut part = |keys: Table| -> Table {
            keys.into_iter().filter_map(|(key, _)| merged.remove(&key).map(|value| (key, value))).collect()
        };
        let wrapper = match defaults.wrapper {
            WrapperSettings::Plain => WrapperSettings::Plain,
            WrapperSettings::Epopt(own) => {
                WrapperSettings::Epopt(part(Table::try_from(own).unwrap_or_default()).try_into()?)
            }
            WrapperSettings::Rl2(own) => {
                WrapperSettings::Rl2(part(Table::try_from(own).unwrap_or_default()).try_into()?)
            }
        };
        let base = match defaults.base {
            BaseSettings::A2c(own) => BaseSettings::A2c(part(Table::try_from(own).unwrap_or_default()).try_into()?),
            BaseSettings::Ppo(own) => BaseSettings::Ppo(part(Table::try_from(own).unwrap_or_default()).try_into()?),
        };
        Ok(Settings { base, wrapper })
    }

    /// γ, per step.
    pub fn gamma(&self) -> f64 {
        match &self.base {
            BaseSettings::A2c(settings) => settings.gamma,
            BaseSettings::Ppo(settings) => settings.gamma,
        }
    }

    /// Episodes in a trial; 1 without trials.
    pub fn episodes_per_trial(&self) -> u32 {
        match &self.wrapper {
            WrapperSettings::Rl2(settings) => settings.episodes_per_trial,
            WrapperSettings::Plain | WrapperSettings::Epopt(_) => 1,
        }
    }

    /// Refuses values outside their ranges, and those that do not go together.
    pub(super) fn validate(&self, architecture: Architecture, num_envs: usize) -> Result<(), ConfigError> {
        match &self.base {
            BaseSettings::A2c(settings) => {
                settings.validate()?;
                check_size(settings.n_steps, num_envs)?;
            }
            BaseSettings::Ppo(settings) => {
                settings.validate()?;
                check_size(settings.n_steps, num_envs)?;
                check_minibatches(settings, architecture, num_envs)?;
            }
        }
        match &self.wrapper {
            WrapperSettings::Plain => Ok(()),
            WrapperSettings::Rl2(settings) => Ok(settings.validate()?),
            WrapperSettings::Epopt(settings) => {
                settings.validate()?;
                let most = settings.episodes_per_iteration;
                if num_envs <= most {
                    return Ok(());
                }
                let expected = format!("at most episodes_per_iteration, {most}: the others would have nothing to do");
                Err(ConfigError::Value { key: "num_envs".into(), got: num_envs.to_string(), expected })
            }
        }
    }
}

/// Whether a rollout is one that a machine can hold.
fn check_size(n_steps: usize, num_envs: usize) -> Result<(), ConfigError> {
    if n_steps as u128 * num_envs as u128 <= MOST_SAMPLES {
        return Ok(());
    }
    let expected = format!("at most {} with {num_envs} environments", MOST_SAMPLES / num_envs as u128);
    Err(ConfigError::Value { key: "n_steps".into(), got: n_steps.to_string(), expected })
}

/// Whether a pass over a rollout can be parted evenly.
fn check_minibatches(settings: &PpoConfig, architecture: Architecture, num_envs: usize) -> Result<(), ConfigError> {
    let PpoConfig { n_steps, n_minibatches, .. } = *settings;
    let (whole, count) = match architecture {
        Architecture::Ff => ("n_steps · num_envs,", n_steps as u128 * num_envs as u128),
        Architecture::Rc => ("num_envs, because a recurrent policy learns from whole environments,", num_envs as u128),
    };
    if count.is_multiple_of(n_minibatches as u128) {
        return Ok(());
    }
    let expected = format!("a divisor of {whole} which is {count}");
    Err(ConfigError::Value { key: "n_minibatches".into(), got: n_minibatches.to_string(), expected })
}

impl BaseSettings {
    /// The defaults of what updates the policy.
    pub(super) fn of(base: Base) -> Self {
        match base {
            Base::A2c => BaseSettings::A2c(A2cConfig::default()),
            Base::Ppo => BaseSettings::Ppo(PpoConfig::default()),
        }
    }
}

impl WrapperSettings {
    /// The defaults of a wrapper.
    pub(super) fn of(wrapper: Wrapper) -> Self {
        match wrapper {
            Wrapper::Plain => WrapperSettings::Plain,
            Wrapper::Epopt => WrapperSettings::Epopt(EpoptConfig::default()),
            Wrapper::Rl2 => WrapperSettings::Rl2(Rl2Config::default()),
        }
    }
}
