//! Errors in a configuration.

use perturb_files::FileError;

use crate::value_error::ValueError;

/// An error in the configuration of a training.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum ConfigError {
    /// The configuration file cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// The configuration file is not TOML, or an argument of `--set` is not `key=value`.
    #[error("{origin}: {reason}")]
    Syntax { origin: String, reason: String },
    /// The configuration has an unknown key.
    #[error("{origin}: unknown key `{key}`{hint}; {algorithm}'s keys are {keys}")]
    UnknownKey {
        origin: String,
        key: String,
        /// A hint: the key that the user probably meant, or the algorithms that have this key.
        hint: String,
        /// The algorithm whose keys are listed.
        algorithm: &'static str,
        keys: String,
    },
    /// The command line has two different values for one setting.
    #[error("{first} and {second} contradict each other: give one of them")]
    Contradiction { first: String, second: String },
    /// A value has the wrong type or is out of range.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The configuration has no environment.
    #[error(
        "no environment was named: give --env NAME, or `environment` in the configuration file; `perturb envs` lists them"
    )]
    NoEnvironment,
    /// The algorithm is RL², but the architecture is feed-forward and so has no memory.
    #[error(
        "{algorithm} cannot train the architecture ff: RL² learns by what a recurrent policy remembers of a trial; give \
         --architecture rc, or another algorithm"
    )]
    NeedsMemory { algorithm: &'static str },
    /// The defaults, the configuration file and the command line cannot be merged.
    #[error("cannot merge the configuration: {0}")]
    Merge(#[from] config::ConfigError),
    /// A setting of the algorithm is out of range.
    #[error(transparent)]
    Setting(#[from] SettingError),
}

/// A setting that is out of range.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} is {got}, but must be {expected}")]
pub struct SettingError {
    /// The setting's key in the configuration file.
    pub name: &'static str,
    /// The given value.
    pub got: String,
    /// The accepted values.
    pub expected: &'static str,
}
