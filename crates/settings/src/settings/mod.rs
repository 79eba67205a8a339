//! The configuration of a training: a flat table of settings.
//!
//! Settings are merged from three layers, each of which overrides those before it: the algorithm's defaults in the
//! preset, the file of `--config FILE.toml`, and the command line (flags and `--set key=value`, which must not
//! contradict each other). The result is written to `config.toml` in the run's directory. A training with this file as
//! `--config` repeats the run.

mod algorithms;
mod architecture;
mod defaults;
mod error;
mod method;
mod observe;
mod preset;

mod base_and_wrapper;

pub use algorithms::{A2cConfig, EpoptConfig, PpoConfig, Ranking, Rl2Config, Schedule};
pub use architecture::Architecture;
pub use base_and_wrapper::{Base, CollectionMode, Settings, Wrapper};
pub use error::{ConfigError, SettingError};
pub use method::Method;
pub use observe::Observe;
pub use preset::Preset;

use std::collections::{BTreeSet, HashMap};
use std::path::Path;
use std::sync::LazyLock;

use config::{Config, File, FileFormat};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use perturb_files as files;
use perturb_protocol::limits::MAX_DRAWN_CONTEXTS;
use perturb_protocol::{Distribution, Version, names};

use crate::sets::{Context, Contexts, Parameters, TestSet};
use crate::value_error::{ValueError, require};

/// Maximal number of environments of one training.
const MAX_ENVS: usize = 65_536;
/// The key of [`Common::parameters`] in a configuration.
const PARAMETERS: &str = "parameters";
/// The key of [`Common::contexts`] in a configuration.
const CONTEXTS: &str = "contexts";
/// The key of the algorithm, [`Settings::name`], in a configuration.
const ALGORITHM: &str = "algorithm";
/// The key of [`Common::preset`] in a configuration.
const PRESET: &str = "preset";
/// The key of [`Common::observe`] in a configuration.
const OBSERVE: &str = "observe";
/// The key of [`Common::architecture`] in a configuration.
const ARCHITECTURE: &str = "architecture";

impl Common {
    /// Describes the parameters of the training: the version, the parameters that replace the version's, and the
    /// contexts, e.g. "D", "D with length [0.3, 0.4]" or "R with 16 contexts of length, mass".
    pub fn trained_on(&self) -> String {
        let own = self.parameters.iter().map(|(name, values)| format!("{name} {values}"));
        let listed = self.contexts.first().map(|context| {
            let names: Vec<&str> = context.keys().map(String::as_str).collect();
            format!("{} contexts of {}", self.contexts.len(), names.join(", "))
        });
        match own.chain(listed).collect::<Vec<_>>() {
            own if own.is_empty() => self.version.to_string(),
            own => format!("{} with {}", self.version, own.join(", ")),
        }
    }

    /// Returns the set of parameters that the training draws from, with this name.
    pub fn training_set(&self, name: &str) -> TestSet {
        let contexts = match self.contexts.as_slice() {
            [] => Contexts::Drawn(self.parameters.clone()),
            contexts => Contexts::Listed(contexts.to_vec()),
        };
        TestSet { name: name.into(), version: self.version, contexts }
    }

    /// Returns the names of the parameters whose values the training determines itself.
    pub fn parameter_names(&self) -> impl Iterator<Item = &str> {
        let listed = self.contexts.first().into_iter().flat_map(Context::keys);
        self.parameters.keys().chain(listed).map(String::as_str)
    }

    fn validate_contexts(&self) -> Result<(), ValueError> {
        let Some(first) = self.contexts.first() else { return Ok(()) };
        let count = self.contexts.len();
        require(count <= MAX_DRAWN_CONTEXTS, CONTEXTS, count, format!("at most {MAX_DRAWN_CONTEXTS} contexts"))?;
        let is_like_first = |context: &Context| context.keys().eq(first.keys());
        let expected = "a list of values of the same parameters, at least one, in each context";
        let is_complete = !first.is_empty() && self.contexts.iter().all(is_like_first);
        require(is_complete, CONTEXTS, "without values of some parameters", expected)?;
        let expected = "alone: add the values of these parameters to each context";
        require(self.parameters.is_empty(), CONTEXTS, "given in addition to parameters", expected)
    }
}

/// The complete configuration of a training. Two trainings with equal configurations produce the same bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Table", into = "Table")]
pub struct TrainConfig {
    /// The settings that are independent of the algorithm.
    pub common: Common,
    /// The settings of the algorithm.
    pub settings: Settings,
}

/// The settings that are independent of the algorithm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Common {
    /// The preset, which chooses the defaults of the other settings: "perturb" or "paper" (default: `"perturb"`).
    pub preset: Preset,
    /// The environment's name in the catalogue. It has no default.
    pub environment: String,
    /// The version from which the environment's parameters are drawn in training: D (deterministic), R (random), E
    /// (extreme) or R+E.
    pub version: Version,
    /// Distributions of individual parameters in training. They replace the distributions of the version. An example is
    /// `length = "0.8..1.0"` in the table `[parameters]` (default: nothing).
    #[serde(default, skip_serializing_if = "Parameters::is_empty")]
    pub parameters: Parameters,
    /// Contexts of the training, 1 … 1024 (default: nothing). Each trial has the values of one of them; all are equally
    /// likely. All contexts have the same parameters; the others are drawn from `version`. Not together with `parameters`.
    /// An example is `contexts = [{ length = 0.3 }, { length = 0.5 }]`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub contexts: Vec<Context>,
    /// The network architecture of the policy.
    pub architecture: Architecture,
    /// The observation of the policy in training and in tests: "state", or "parameters" for the state and the current
    /// parameters of the environment (default: `"state"`). `config.toml` contains this setting only if it is not the
    /// default. Without it, the file has the same bytes as in earlier versions, which did not have the setting.
    #[serde(default, skip_serializing_if = "Observe::is_default")]
    pub observe: Observe,
    /// The number of episodes after which training ends, at least 1 (default: `15000`). The last iteration is
    /// completed. EPOpt counts only the episodes that it learned from.
    pub episodes: u64,
    /// The seed of all random numbers, 0 … 2⁶³-1 (default: `1`).
    pub seed: u64,
    /// N, the number of environments that are stepped together, 1 … 65536 (default: `16`, `8` with PPO FF, `25` with
    /// EPOpt; paper: `1`). A larger number makes each step cheaper and updates rarer.
    pub num_envs: usize,
    /// Whether observations are normalised by their running mean and variance (default: `true`).
    pub normalize_observations: bool,
    /// Standard deviation of normally distributed noise that is added to every number of an observation in training,
    /// after normalisation if there is any, 0 … 100 (default: `0`). Tests have no noise. `config.toml` contains this
    /// setting only if it is not the default. Without it, the file has the same bytes as in earlier versions, which did
    /// not have the setting.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub observation_noise: f64,
    /// Whether rewards are divided by the running standard deviation of the discounted return (default: `true`).
    pub normalize_rewards: bool,
    /// Whether the discounted return for normalising rewards continues across the ends of episodes, as in the code of
    /// Packer et al. (2018), instead of starting again from 0 (default: `false`; paper: `true`).
    pub reward_return_runs_on: bool,
    /// The number of iterations between two lines of progress.csv, at least 1 (default: `100` with A2C and RL²-A2C,
    /// else `1`). A line contains the figures of the last update, and means over the last 100 ended episodes.
    pub log_interval: u64,
    /// The number of ended episodes between two checkpoints, at least 1 (default: `500`). The first and the last
    /// iteration always write a checkpoint.
    pub checkpoint_interval: u64,
    /// A success rate in %, 0 … 100, at which training ends early: after the iteration in which the last 100 ended
    /// episodes reach it (default: `0`, which is never). Longer training can impair generalisation. `config.toml`
    /// contains this setting only if it is not the default. Without it, the file has the same bytes as in earlier
    /// versions, which did not have the setting.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub stop_at_success: f64,
}

fn is_zero(number: &f64) -> bool {
    *number == 0.0
}

impl TrainConfig {
    /// Merges and checks a configuration. The values of the command line override those of the TOML file `file`: `sets`
    /// are pairs `key=value`, and `flags` are flags by the setting's key.
    ///
    /// # Errors
    /// [`ConfigError`] with the key and the accepted values.
    pub fn load(file: Option<&Path>, sets: &[String], flags: Table) -> Result<Self, ConfigError> {
        let mut layers: Vec<(String, Table)> = Vec::new();
        if let Some(path) = file {
            let shown = path.display().to_string();
            tracing::debug!("settings are read from {shown}");
            let table = files::read_toml(path)?.parse::<Table>().map_err(|error| ConfigError::Syntax {
                origin: shown.clone(),
                reason: error.to_string().trim().to_owned(),
            })?;
            let table = spelled(&shown, table)?;
            layers.push((shown, table));
        }
        let mut typed: Vec<(String, Table)> = Vec::new();
        for set in sets {
            let origin = format!("--set {set}");
            let table = spelled(&origin, parse_set(set)?)?;
            typed.push((origin, table));
        }
        typed.extend(flags.into_iter().map(|(key, value)| (flag(&key, &value), Table::from_iter([(key, value)]))));
        refuse_contradictions(&typed)?;
        layers.append(&mut typed);
        resolve(layers)
    }

    /// Returns the configuration as TOML text with every setting.
    pub fn to_toml(&self) -> String {
        // Serialisation of plain numbers, booleans and names cannot fail.
        toml::to_string(&self.full_table()).unwrap_or_default()
    }

    /// Returns the configuration as a flat table, which [`TrainConfig::from_table`] reads. With the default preset, the
    /// table omits the settings that earlier versions of the program did not have, if they are set to the behaviour of
    /// those versions. The table is therefore the same as the one that an earlier version wrote.
    pub fn table(&self) -> Table {
        let mut table = self.full_table();
        if self.common.preset.is_default() {
            preset::leave_out_younger(&mut table);
        }
        table
    }

    fn full_table(&self) -> Table {
        let mut table = Table::try_from(&self.common).unwrap_or_default();
        table.insert(ALGORITHM.into(), self.settings.name().into());
        table.extend(self.settings.table());
        table
    }

    /// Reads a configuration from a flat table. Missing settings get their defaults.
    ///
    /// # Errors
    /// [`ConfigError`] with the key and the accepted values.
    pub fn from_table(origin: &str, table: Table) -> Result<Self, ConfigError> {
        resolve(vec![(origin.to_owned(), spelled(origin, table)?)])
    }

    /// Returns the configuration with every key that a training with this algorithm may have. Reports compare
    /// configurations in this form.
    pub fn complete_table(&self) -> Table {
        let mut table = defaults_of(self);
        table.extend(self.full_table());
        table
    }

    /// Returns how rollouts are collected.
    pub fn rollouts(&self) -> CollectionMode {
        if self.common.observation_noise > 0.0 { CollectionMode::Noisy } else { self.settings.rollouts() }
    }

    /// Returns the method that the configuration trains.
    pub fn method(&self) -> Method {
        let Self { common, settings } = self;
        Method {
            algorithm: settings.name().to_owned(),
            architecture: common.architecture.to_string(),
            episodes_per_trial: settings.has_trials().then(|| settings.episodes_per_trial()),
            preset: common.preset,
            observe: common.observe,
            external: false,
        }
    }

    fn validate(&self) -> Result<(), ConfigError> {
        let Common { episodes, num_envs, log_interval, checkpoint_interval, .. } = self.common;
        if self.common.environment.is_empty() {
            return Err(ConfigError::NoEnvironment);
        }
        for (key, value, most) in [
            ("episodes", episodes, u64::MAX),
            ("num_envs", num_envs as u64, MAX_ENVS as u64),
            ("log_interval", log_interval, u64::MAX),
            ("checkpoint_interval", checkpoint_interval, u64::MAX),
        ] {
            let expected = if most == u64::MAX { "at least 1".to_owned() } else { format!("between 1 and {most}") };
            require((1..=most).contains(&value), key, value, expected)?;
        }
        self.common.validate_contexts()?;
        let noise = self.common.observation_noise;
        require((0.0..=100.0).contains(&noise), "observation_noise", noise, "a standard deviation, 0 … 100")?;
        let rate = self.common.stop_at_success;
        require((0.0..=100.0).contains(&rate), "stop_at_success", rate, "a success rate, 0 … 100 %")?;
        let architecture = self.common.architecture;
        if self.settings.has_trials() && architecture == Architecture::Ff {
            return Err(ConfigError::NeedsMemory { algorithm: self.settings.name() });
        }
        self.settings.validate(architecture, num_envs)
    }
}

/// Describes the training in a few words: environment, version, algorithm and architecture, e.g. "Hopper R ppo ff".
impl std::fmt::Display for TrainConfig {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Common { environment, version, .. } = &self.common;
        write!(f, "{environment} {version} {}", self.method())
    }
}

impl TryFrom<Table> for TrainConfig {
    type Error = ConfigError;

    fn try_from(table: Table) -> Result<Self, ConfigError> {
        Self::from_table("the configuration", table)
    }
}

impl From<TrainConfig> for Table {
    fn from(config: TrainConfig) -> Self {
        config.table()
    }
}

/// Returns a flag as the user typed it, but without the value if it is a table.
fn flag(key: &str, value: &Value) -> String {
    let name = if key == "environment" { "env".to_owned() } else { key.replace('_', "-") };
    match value {
        Value::Table(_) => format!("--{name}"),
        Value::String(text) => format!("--{name} {text}"),
        value => format!("--{name} {value}"),
    }
}

/// Returns an error if the command line has two different values for one setting, because the user may have intended
/// either value.
fn refuse_contradictions(typed: &[(String, Table)]) -> Result<(), ConfigError> {
    let same = |a: &Value, b: &Value| match (a, b) {
        (Value::String(a), Value::String(b)) => names::is_spelled(a, b),
        (a, b) => a == b,
    };
    let all = || typed.iter().flat_map(|(origin, table)| table.iter().map(move |entry| (origin, entry)));
    for (index, (origin, (key, value))) in all().enumerate() {
        if let Some((first, _)) = all().take(index).find(|(_, (known, other))| *known == key && !same(other, value)) {
            return Err(ConfigError::Contradiction { first: first.clone(), second: origin.clone() });
        }
    }
    Ok(())
}

/// Returns a table whose keys have their usual spelling. Unknown keys are not changed.
///
/// # Errors
/// [`ConfigError::Contradiction`] if a key occurs in two spellings.
pub fn spelled(origin: &str, table: Table) -> Result<Table, ConfigError> {
    let known = &*ALL_KEYS;
    let mut spelled = Table::new();
    let mut written: HashMap<String, String> = HashMap::new();
    for (key, value) in table {
        let name =
            names::find(&key, known.iter().map(String::as_str)).map_or_else(|| key.clone(), |i| known[i].clone());
        if let Some(first) = written.insert(name.clone(), key.clone()) {
            return Err(ConfigError::Contradiction { first: format!("{origin}: {first}"), second: key });
        }
        spelled.insert(name, value);
    }
    Ok(spelled)
}

/// The keys of all settings of all algorithms, sorted.
static ALL_KEYS: LazyLock<Vec<String>> = LazyLock::new(|| {
    let of = |settings| defaults_of(&defaults::defaults_for(settings, Architecture::Rc, Preset::default()));
    let keys: BTreeSet<String> = Settings::all().into_iter().flat_map(of).map(|(key, _)| key).collect();
    keys.into_iter().collect()
});

/// Returns every key that a configuration with this algorithm may have, with its default.
fn defaults_of(config: &TrainConfig) -> Table {
    let mut defaults = config.full_table();
    // `full_table` leaves out these settings if they have their defaults, so they are added here.
    defaults.insert(PARAMETERS.into(), Value::Table(Table::new()));
    defaults.insert(CONTEXTS.into(), Value::Array(Vec::new()));
    defaults.insert("stop_at_success".into(), 0.0.into());
    if config.settings.learns() {
        defaults.insert("observation_noise".into(), 0.0.into());
        defaults.insert("weight_decay".into(), 0.0.into());
    }
    defaults.insert(OBSERVE.into(), Observe::default().to_string().into());
    defaults
}

/// Returns the permitted values of the setting `key`, or `None` if its values are not names.
fn choices(key: &str) -> Option<Vec<&'static str>> {
    Some(match key {
        ALGORITHM => Settings::names().to_vec(),
        "version" => Version::NAMES.to_vec(),
        ARCHITECTURE => Architecture::NAMES.to_vec(),
        "learning_rate_schedule" => vec!["constant", "linear"],
        PRESET => Preset::NAMES.to_vec(),
        OBSERVE => Observe::NAMES.to_vec(),
        "rank_by" => vec!["raw", "normalized"],
        _ => return None,
    })
}

/// Merges `layers` with the defaults of the algorithm that they name, and checks the result. Each layer is a table with
/// a name for error messages.
fn resolve(mut layers: Vec<(String, Table)>) -> Result<TrainConfig, ConfigError> {
    // Replaces the values that are names by their usual spelling.
    for (key, value) in layers.iter_mut().flat_map(|(_, table)| table.iter_mut()) {
        let known = choices(key).unwrap_or_default();
        if let Some(place) = value.as_str().and_then(|written| names::find(written, known.iter().copied())) {
            *value = known[place].into();
        }
    }
    // The algorithm, the architecture and the preset determine the defaults. Each is taken from the last layer that
    // contains it.
    let named = |key: &str| layers.iter().rev().find_map(|(_, table)| table.get(key));
    let algorithm = named(ALGORITHM).cloned().unwrap_or_else(|| "ppo".into());
    let algorithm = Settings::all()[choice(ALGORITHM, &algorithm, &Settings::names())?].clone();
    let name = algorithm.name();
    let architecture = match named(ARCHITECTURE) {
        None => algorithm.default_architecture(),
        Some(value) => Architecture::ALL[choice(ARCHITECTURE, value, &Architecture::NAMES)?],
    };
    let preset = match named(PRESET) {
        None => Preset::default(),
        Some(value) => Preset::ALL[choice(PRESET, value, &Preset::NAMES)?],
    };
    let config = defaults::defaults_for(algorithm, architecture, preset);
    let defaults = defaults_of(&config);
    for (origin, table) in &layers {
        for (key, value) in table {
            check(origin, key, value, &defaults, name)?;
        }
    }
    // Each layer overrides the layers before it.
    let mut builder = Config::builder().add_source(source(&defaults));
    for (_, table) in &layers {
        builder = builder.add_source(source(table));
    }
    let merged: Table = builder.build()?.try_deserialize()?;
    let wrong = |error: toml::de::Error| ConfigError::Syntax {
        origin: "the configuration".into(),
        reason: error.to_string().trim().replace('\n', ", "),
    };
    let settings = config.settings.read(&merged).map_err(wrong)?;
    let config = TrainConfig { common: merged.try_into().map_err(wrong)?, settings };
    config.validate()?;
    Ok(config)
}

/// Parses `key=value`, where the value is TOML. A value that is not valid TOML is taken as a string.
fn parse_set(set: &str) -> Result<Table, ConfigError> {
    let Some((key, value)) = set.split_once('=') else {
        let reason = "expected key=value, e.g. --set learning_rate=3e-4".into();
        return Err(ConfigError::Syntax { origin: format!("--set {set}"), reason });
    };
    let (key, value) = (key.trim(), value.trim());
    let parsed = format!("value = {value}").parse::<Table>().ok().filter(|table| table.len() == 1);
    let value = parsed.and_then(|mut table| table.remove("value")).unwrap_or_else(|| Value::String(value.to_owned()));
    Ok(Table::from_iter([(key.to_owned(), value)]))
}

/// Converts a table to a source of the crate `config`.
fn source(table: &Table) -> File<config::FileSourceString, FileFormat> {
    File::from_str(&toml::to_string(table).unwrap_or_default(), FileFormat::Toml)
}

/// Checks that `key` exists and that `value` has the type of the setting.
fn check(origin: &str, key: &str, value: &Value, defaults: &Table, algorithm: &'static str) -> Result<(), ConfigError> {
    let Some(default) = defaults.get(key) else {
        let keys = || defaults.keys().map(String::as_str);
        let hint = others_setting(key).unwrap_or_else(|| names::did_you_mean(key, keys()));
        let keys = keys().collect::<Vec<_>>().join(", ");
        return Err(ConfigError::UnknownKey { origin: origin.to_owned(), key: key.to_owned(), hint, algorithm, keys });
    };
    let choices = choices(key);
    let expected = match (default, value) {
        _ if choices.is_some() => return choice(key, value, &choices.unwrap_or_default()).map(drop),
        (Value::Float(_), Value::Float(_) | Value::Integer(_)) => return Ok(()),
        (Value::Integer(_), Value::Integer(0..)) => return Ok(()),
        (Value::Boolean(_), Value::Boolean(_)) | (Value::String(_), Value::String(_)) => return Ok(()),
        (Value::Table(_), Value::Table(parameters)) => return check_parameters(parameters),
        (Value::Table(_), _) => "a table of parameters and their values",
        (Value::Array(_), contexts) if contexts.clone().try_into::<Vec<Context>>().is_ok() => return Ok(()),
        (Value::Array(_), _) => "a list of contexts, such as [{ length = 0.3 }, { length = 0.5 }]",
        (Value::Float(_), _) => "a number",
        (Value::Integer(_), Value::Float(number)) if number.fract() == 0.0 && (0.0..1e15).contains(number) => {
            let expected = format!("a whole number that is not negative, in digits: {number}");
            return Err(ValueError::new(key, value, expected).into());
        }
        (Value::Integer(_), _) => "a whole number that is not negative",
        (Value::Boolean(_), _) => "true or false",
        _ => "a text",
    };
    Err(ValueError::new(key, value, expected).into())
}

/// Returns a hint such as "; it is a setting of rl2-a2c, rl2-ppo", or `None` if no algorithm has the setting.
fn others_setting(key: &str) -> Option<String> {
    let has = |settings: &Settings| {
        defaults_of(&defaults::defaults_for(settings.clone(), Architecture::Rc, Preset::default())).contains_key(key)
    };
    let having = Settings::all().into_iter().filter(has);
    let names: Vec<&str> = having.map(|settings| settings.name()).collect();
    (!names.is_empty()).then(|| format!("; it is a setting of {}", names.join(", ")))
}

/// Checks that every value of the table `[parameters]` is a distribution.
fn check_parameters(parameters: &Table) -> Result<(), ConfigError> {
    let expected = "a value, or a text such as \"0.3..0.4\" or \"0.3..0.4,0.8..0.9\"";
    for (name, value) in parameters {
        let is_distribution = value.clone().try_into::<Distribution>().is_ok();
        require(is_distribution, format!("{PARAMETERS}.{name}"), value, expected)?;
    }
    Ok(())
}

/// Returns the index of a value in the list of permitted names.
fn choice(key: &str, value: &Value, known: &[&str]) -> Result<usize, ConfigError> {
    known.iter().position(|name| value.as_str() == Some(name)).ok_or_else(|| {
        let hint = names::did_you_mean(value.as_str().unwrap_or_default(), known.iter().copied());
        let known: Vec<String> = known.iter().map(|name| format!("\"{name}\"")).collect();
        ValueError::new(key, value, format!("one of {}{hint}", known.join(", "))).into()
    })
}

#[cfg(test)]
mod tests;
