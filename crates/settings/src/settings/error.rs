//! Why a configuration is refused.

use perturb_files::FileError;

use crate::value_error::ValueError;

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum ConfigError {
    /// A file cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is not TOML, or a `--set` is not `key=value`.
    #[error("{origin}: {reason}")]
    Syntax { origin: String, reason: String },
    /// A key does not exist.
    #[error("{origin}: unknown key `{key}`{hint}; {algorithm}'s keys are {keys}")]
    UnknownKey {
        origin: String,
        key: String,
        /// The probable key, or the algorithm that has this key.
        hint: String,
        /// The algorithm whose keys were searched.
        algorithm: &'static str,
        keys: String,
    },
    /// The command line gives one setting two values.
    #[error("{first} and {second} contradict each other: give one of them")]
    Contradiction { first: String, second: String },
    /// A value has the wrong type or lies outside its range.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// No environment was named.
    #[error(
        "no environment was named: give --env NAME, or `environment` in the configuration file; `perturb envs` lists them"
    )]
    NoEnvironment,
    /// RL² was asked to train a policy without memory.
    #[error(
        "{algorithm} cannot train the architecture ff: RL² learns by what a recurrent policy remembers of a trial; give \
         --architecture rc, or another algorithm"
    )]
    NeedsMemory { algorithm: &'static str },
    /// The layers cannot be merged.
    #[error("cannot merge the configuration: {0}")]
    Merge(#[from] config::ConfigError),
    /// The algorithm refuses its settings.
    #[error(transparent)]
    Setting(#[from] SettingError),
}

/// A setting is outside its range.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} is {got}, but must be {expected}")]
pub struct SettingError {
    /// The setting, as written in the configuration file.
    pub name: &'static str,
    /// The value that was given.
    pub got: String,
    /// The accepted values.
    pub expected: &'static str,
}
