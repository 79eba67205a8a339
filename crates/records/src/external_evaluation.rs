//! Recorded tests of agents that were not trained by an experiment. `Assessment.save` of the Python package writes
//! them, and reports show them beside an experiment's own results.
//!
//! ```text
//! DIR/assessment.json        the agent, and metadata of each of its policies
//! DIR/episodes.parquet       the recorded tests of a policy; with several policies episodes-D.parquet and so on
//! ```
//!
//! Every number in a report is computed from the records. The records do not say how an agent was trained, so the
//! agent has no settings.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Duration;

use perturb_files::checksum::WithChecksum;
use perturb_files::{self as files, FileError, checksum, read_if_exists};
use perturb_protocol::Version;
use perturb_settings::{Method, Observe, Preset, ValueError};
use serde::{Deserialize, Serialize};

use crate::outcomes::PolicyOutcomes;
use crate::records::{FILE, Records, RecordsError};
use crate::results::TestResult;
use crate::scenarios::TrainedOn;
use crate::success::Rule;

/// The name of the file that lists the other files of an evaluation.
pub const ASSESSMENT: &str = "assessment.json";
/// Format version of `assessment.json`. Increase it when older programs could misread the file.
const FORMAT_VERSION: u32 = 1;
/// Maximum number of attempts to read a folder, in case another program is replacing its files.
const MAX_LOOKS: u32 = 3;
/// Time between two attempts.
const RETRY_INTERVAL: Duration = Duration::from_millis(50);

/// The recorded tests of an agent in one environment.
#[derive(Clone, Debug, PartialEq)]
pub struct ExternalEvaluation {
    /// The name of the evaluation in reports. It is the name of its folder, or empty if it was never saved.
    pub name: String,
    /// The name of the agent in reports, e.g. "PPO".
    pub agent: String,
    /// The agent's policies, at least one. All are of the same environment, and each has a different training
    /// distribution.
    policies: Vec<ExternalPolicy>,
}

/// A policy of an agent that was not trained by an experiment, with its recorded tests.
#[derive(Clone, Debug, PartialEq)]
pub struct ExternalPolicy {
    /// Metadata of the policy that the records do not contain.
    pub known: PolicyMetadata,
    /// The recorded episodes of all its tests.
    pub records: Records,
    results: BTreeMap<String, TestResult>,
    outcomes: PolicyOutcomes,
}

/// Metadata of a policy that was not trained by an experiment. The policy's records do not contain these data.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PolicyMetadata {
    /// The version (parameter distribution D, R, E or R+E) on which the policy was trained. `None` if unknown, or if
    /// the policy was trained on other parameters.
    pub trained_on: Option<Version>,
    /// Number of training steps, summed over all environments; `None` if unknown.
    pub timesteps: Option<u64>,
    /// The seed from which the seeds of the tests are derived.
    pub seed: u64,
    /// Number of episodes requested for each test.
    pub episodes: u64,
    /// The quantities that the policy observes.
    pub observe: Observe,
    /// Whether actions were the mode of the policy's distribution instead of samples. `None` if the evaluation did not
    /// control how actions are chosen.
    pub deterministic: Option<bool>,
}

/// The content of `assessment.json`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct EvaluationDocument {
    format_version: u32,
    environment: String,
    agent: String,
    policies: Vec<PolicyEntry>,
}

#[derive(Serialize, Deserialize)]
struct PolicyEntry {
    file: String,
    #[serde(flatten)]
    known: PolicyMetadata,
}

/// A failure to read, write or combine the tests of an agent that was not trained by an experiment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum ExternalEvaluationError {
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The recorded episodes are missing or damaged.
    #[error(transparent)]
    Records(#[from] RecordsError),
    /// The folder does not contain an `assessment.json`.
    #[error("{} holds no assessment: it has no {ASSESSMENT}; give a folder that Assessment.save wrote", path.display())]
    Missing { path: PathBuf },
    /// `assessment.json` is damaged, or was written by an incompatible program.
    #[error("{} is damaged: {reason}", path.display())]
    Damaged {
        path: PathBuf,
        /// The fault.
        reason: String,
    },
    /// `assessment.json` has a format version that this program cannot read.
    #[error("{} has format {got}; this program reads {FORMAT_VERSION}", path.display())]
    Format { path: PathBuf, got: u64 },
    /// There are no policies, the policies are of different environments, or two have the same training distribution
    /// or an unknown one.
    #[error("policies of an assessment have one environment and different training distributions, but {got}")]
    Mixed {
        /// The last clause of the message. It describes the policies that were given, e.g. "they are of CartPole and
        /// Pendulum".
        got: String,
    },
    /// The folder to write to is not empty.
    #[error("{} is not empty; {instead}", path.display())]
    NotEmpty {
        path: PathBuf,
        /// Advice for the user.
        instead: &'static str,
    },
}

type Result<T> = std::result::Result<T, ExternalEvaluationError>;

impl ExternalPolicy {
    /// Creates a policy and computes the results of its recorded tests.
    pub fn new(known: PolicyMetadata, records: Records) -> Self {
        let names = || records.about.tests.iter().map(|test| test.set.name.as_str());
        let results = names().map(|name| (name.to_owned(), records.result(name, None))).collect();
        let outcomes = PolicyOutcomes::new(&records, names());
        Self { known, records, results, outcomes }
    }

    /// Returns the results of the test on the set or version called `tested_on`; `None` if the policy was not tested on
    /// it.
    pub fn test(&self, tested_on: &str) -> Option<&TestResult> {
        self.results.get(tested_on)
    }

    /// Returns the parameters and outcomes of the episodes, by test.
    pub fn outcomes(&self) -> &PolicyOutcomes {
        &self.outcomes
    }

    /// Returns the name of the file with the policy's records in an evaluation's folder.
    pub fn file_name(&self) -> String {
        let of = |version: Version| format!("episodes-{}.parquet", version.file_name());
        self.known.trained_on.map_or_else(|| FILE.to_owned(), of)
    }

    /// Returns the training distribution of the policy.
    pub fn trained_on<'a>(&self) -> TrainedOn<'a> {
        self.known.trained_on.map_or(TrainedOn::Unknown, TrainedOn::Version)
    }
}

impl ExternalEvaluation {
    /// Creates an evaluation from at least one policy.
    ///
    /// # Errors
    /// [`ExternalEvaluationError::Mixed`] if there is no policy, if environments differ, or if two policies have the
    /// same training distribution.
    pub fn new(name: String, agent: String, policies: Vec<ExternalPolicy>) -> Result<Self> {
        let environments: BTreeSet<&str> = policies.iter().map(|it| it.records.about.environment.as_str()).collect();
        let trained: BTreeSet<_> = policies.iter().map(ExternalPolicy::trained_on).collect();
        if environments.len() != 1 {
            let listed = environments.into_iter().collect::<Vec<_>>().join(" and ");
            let got = if listed.is_empty() { "there is none".into() } else { format!("they are of {listed}") };
            return Err(ExternalEvaluationError::Mixed { got });
        }
        if trained.len() != policies.len() {
            let got = "two have the same training distribution or an unknown one".into();
            return Err(ExternalEvaluationError::Mixed { got });
        }
        Ok(Self { name, agent, policies })
    }

    /// Returns the name of the environment.
    pub fn environment(&self) -> &str {
        &self.policies[0].records.about.environment
    }

    /// Returns the policies.
    pub fn policies(&self) -> &[ExternalPolicy] {
        &self.policies
    }

    /// Returns the name and settings of a method, under which reports list the agent.
    pub fn method(&self) -> Method {
        Method {
            algorithm: self.agent.clone(),
            architecture: String::new(),
            episodes_per_trial: None,
            preset: Preset::default(),
            observe: self.policies[0].known.observe,
            external: true,
        }
    }

    /// Returns whether the folder `path` contains an `assessment.json`.
    pub fn is_in(path: &Path) -> bool {
        path.join(ASSESSMENT).is_file()
    }

    /// Reads an evaluation from the folder `path`. If the folder has an `assessment.json` but cannot be read, tries up
    /// to three times, because another program may be replacing the files.
    ///
    /// # Errors
    /// [`ExternalEvaluationError`], with the path of the file.
    pub fn read(path: &Path) -> Result<Self> {
        for _ in 1..MAX_LOOKS {
            match Self::read_once(path) {
                Err(error) if Self::is_in(path) && !matches!(error, ExternalEvaluationError::Format { .. }) => {
                    std::thread::sleep(RETRY_INTERVAL);
                }
                read => return read,
            }
        }
        Self::read_once(path)
    }

    fn read_once(path: &Path) -> Result<Self> {
        let json = path.join(ASSESSMENT);
        let Some(text) = read_if_exists(&json)? else {
            return Err(ExternalEvaluationError::Missing { path: path.to_owned() });
        };
        let broken = |reason: String| ExternalEvaluationError::Damaged { path: json.clone(), reason };
        let damaged = |error: serde_json::Error| broken(error.to_string());
        let mut value: serde_json::Value = serde_json::from_slice(&text).map_err(damaged)?;
        match value.get("format_version").and_then(serde_json::Value::as_u64) {
            Some(got) if got != u64::from(FORMAT_VERSION) => {
                return Err(ExternalEvaluationError::Format { path: json, got });
            }
            _ => {}
        }
        checksum::open(&mut value).map_err(|reason| broken(reason.into()))?;
        let document: EvaluationDocument = serde_json::from_value(value).map_err(damaged)?;
        let mut policies = Vec::new();
        for PolicyEntry { file, known } in document.policies {
            // Uses only the last component of the path, because the file must be in this folder.
            let file = Path::new(&file).file_name().unwrap_or_default();
            let policy = ExternalPolicy::new(known, Records::read(&path.join(file))?);
            if file != policy.file_name().as_str() {
                let reason =
                    format!("the records of its policy are in {}, expected {}", file.display(), policy.file_name());
                return Err(ExternalEvaluationError::Damaged { path: json, reason });
            }
            policies.push(policy);
        }
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        Self::new(name, document.agent, policies)
    }

    /// Writes the evaluation to the folder `path`. The folder must be new or empty, unless it contains an evaluation
    /// and `overwrite` is set. When an evaluation is overwritten, deletes only its records files that are no longer
    /// needed.
    ///
    /// # Errors
    /// [`ExternalEvaluationError`] if the folder is not empty or a file cannot be written. Old files are deleted only
    /// after all new files are written. So after a failure an old `assessment.json` still exists, and a new folder has
    /// none.
    pub fn write(&self, path: &Path, overwrite: bool) -> Result<()> {
        let (json, is_one) = (path.join(ASSESSMENT), Self::is_in(path));
        let replaced = overwrite && is_one;
        if !replaced && !files::list(path)?.is_empty() {
            let instead = if is_one { "overwrite=True replaces it" } else { "name another folder" };
            return Err(ExternalEvaluationError::NotEmpty { path: path.to_owned(), instead });
        }
        let former = records_named_in(&json)?;
        let mut entries = Vec::new();
        for policy in &self.policies {
            let file = policy.file_name();
            policy.records.write(&path.join(&file))?;
            entries.push(PolicyEntry { file, known: policy.known.clone() });
        }
        let (environment, agent) = (self.environment().to_owned(), self.agent.clone());
        let document = EvaluationDocument { format_version: FORMAT_VERSION, environment, agent, policies: entries };
        let sealed = WithChecksum::new(&document).map_err(|error| files::io("write", &json)(error.into()))?;
        files::write_json(&json, &sealed)?;
        let is_kept = |file: &str| document.policies.iter().any(|entry| entry.file == file);
        let gone = former.iter().filter(|file| !is_kept(file));
        Ok(gone.map(|file| path.join(file)).try_for_each(|path| files::delete(&path))?)
    }

    /// Determines the success of all episodes by `rule` instead of the recorded rule.
    ///
    /// # Errors
    /// [`ValueError`] if `rule` cannot be applied to the recorded episodes.
    pub fn judged_by(self, rule: &Rule) -> std::result::Result<Self, ValueError> {
        let judge = |policy: ExternalPolicy| {
            let same = policy.records.about.criterion(rule).ok() == policy.records.about.success;
            let records = if same { policy.records } else { policy.records.judged_by(rule)? };
            Ok(ExternalPolicy::new(policy.known, records))
        };
        let Self { name, agent, policies } = self;
        let policies = policies
            .into_iter()
            .map(judge)
            .collect::<std::result::Result<_, ValueError>>()
            .map_err(|error| ValueError { what: format!("{name}: {}", error.what), ..error })?;
        Ok(Self { name, agent, policies })
    }
}

/// Returns the names of the records files that the document `json` lists. Returns an empty set if the document is
/// missing or cannot be parsed.
fn records_named_in(json: &Path) -> Result<BTreeSet<String>> {
    let text = read_if_exists(json)?.unwrap_or_default();
    let mut value = serde_json::from_slice(&text).unwrap_or_default();
    // Ignores a wrong checksum, because only the names of the files are needed.
    let _ = checksum::open(&mut value);
    let entries =
        serde_json::from_value(value).map_or_else(|_| Vec::new(), |document: EvaluationDocument| document.policies);
    let names = entries.iter().filter_map(|entry| Path::new(&entry.file).file_name()?.to_str());
    let is_records = |name: &&str| name.starts_with("episodes") && name.ends_with(".parquet");
    Ok(names.filter(is_records).map(str::to_owned).collect())
}

#[cfg(test)]
#[path = "external_evaluation_tests.rs"]
mod tests;
