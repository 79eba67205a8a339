//! Reads and writes the files in the folder of an experiment.
//!
//! ```text
//! DIR/plan.toml                   a copy of the experiment file
//! DIR/NAME.csv                    copies of the CSV files that the experiment file names
//! DIR/cells/ID/result.json        the cell's result, written last
//! DIR/cells/ID/failure.json       the reason why the cell failed
//! DIR/cells/ID/timing.json        the duration of the cell, which differs from run to run
//! DIR/cells/ID/training/          the output of `perturb train --out`; its subfolder marks/ has intermediate policies
//! DIR/cells/ID/episodes.parquet   the recorded test episodes of the final policy
//! DIR/cells/ID/marks/             the recorded test episodes of intermediate policies
//! DIR/cells/ID/log.txt            warnings of worker processes
//! DIR/cells/ID/lock               locked while a process works on the cell
//! DIR/heatmaps/                   the output of `perturb heatmap DIR`
//! DIR/report/                     the output of `perturb report`
//! ```
//!
//! All files except `log.txt` and the logs in `training/` are written atomically. So if such a file exists, it is
//! complete.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use perturb_checkpoint::Counters;
use perturb_files::checksum::WithChecksum;
use perturb_files::{self as files, FileError, Lock, checksum, write_atomically};
use perturb_protocol::{Version, proto};
use perturb_records::{ParameterCheck, TestResult};
use perturb_settings::Method;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::plan::Plan;

/// Format version of `result.json`. It is raised when older programs could misread the file.
const FORMAT_VERSION: u32 = 1;
/// Maximum size of a JSON file of a cell, in bytes.
const MAX_BYTES: u64 = 64 << 20;

/// The folder of an experiment: its plan and the folders of its cells.
#[derive(Clone, Debug)]
pub struct ExperimentFolder {
    path: PathBuf,
    /// The folder to which new heatmaps are written; `None` for the experiment's own folder `heatmaps`.
    new_heatmaps: Option<PathBuf>,
}

/// The folder of a cell: its result or failure, its training and its recorded episodes.
#[derive(Clone, Debug)]
pub struct CellFolder {
    path: PathBuf,
}

/// Identity of a file `failure.json`. A file that replaces it has another identity, even with the same content.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailureId {
    /// The inode of the file. Another file may get this number after the file is deleted, so the time is compared too.
    inode: u64,
    /// The time of the last write: seconds and nanoseconds since 1970.
    written: (i64, i64),
}

/// The state of a cell.
#[derive(Clone, Debug, PartialEq)]
pub enum CellState {
    /// The cell has a result.
    Done(Box<CellResult>),
    /// The cell failed, and has no result.
    Failed(FailureRecord),
    /// The cell has neither a result nor a failure.
    Missing,
}

/// The content of `result.json`. It depends only on the plan and the program, so running the cell again gives the same
/// bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellResult {
    /// The format version of the file.
    pub format_version: u32,
    /// The id of the cell.
    pub id: String,
    /// The training that made the policy.
    pub training: Training,
    /// Success rate, mean return and mean length by test set: "D", "R", "E", "R+E" or the name of one of the plan's
    /// parameter sets.
    pub results: BTreeMap<String, TestResult>,
    /// Tests of intermediate policies. The key is the number of training episodes after which the policy was stored.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub marks: BTreeMap<u64, IntermediateEvaluation>,
    /// Comparison of requested and applied parameters in the tests; `None` in results of earlier programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub agreement: Option<ParameterCheck>,
    /// The program's version and the commit that it was built from.
    pub commit: String,
    /// Other versions of the program that did a part of the training before it was interrupted and resumed, in order.
    /// Each has the form of `commit`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub earlier_commits: Vec<String>,
    /// The shell command that reproduces the result without the plan.
    pub command: String,
}

/// Tests of an intermediate policy, which was stored during the training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntermediateEvaluation {
    /// The progress of the training when the policy was stored: at the end of the iteration that reached the required
    /// number of episodes.
    pub counters: Counters,
    /// Results by test set, as in [`CellResult::results`].
    pub results: BTreeMap<String, TestResult>,
    /// Comparison of requested and applied parameters in these tests.
    pub agreement: ParameterCheck,
}

/// The description of a training in a result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Training {
    /// The environment's name in the catalogue.
    pub environment: String,
    /// The environment's revision on the server. Every change of dynamics, reward or observation raises it.
    pub environment_revision: u32,
    /// SHA-256 in hexadecimal of the model's MJCF text, or of all files of the task folder that the server read. Empty
    /// for an environment without a model.
    pub model_hash: String,
    /// The version that all parameters are drawn from, except those in the table `parameters` of `settings`.
    pub version: Version,
    /// The name of the plan's parameter set that the policy was trained on; `None` if it was trained on a version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set: Option<String>,
    /// The method: algorithm, architecture and kind of observation.
    #[serde(flatten)]
    pub method: Method,
    /// A hash of settings and tests, see [`Cell::configuration`](crate::plan::Cell::configuration).
    pub configuration: String,
    /// The number of the run, from 1.
    pub run: u32,
    /// The seed of the training and of the tests.
    pub seed: u64,
    /// The final counters of the training: iterations, timesteps, episodes.
    pub counters: Counters,
    /// All settings of the training, as in `config.toml`.
    pub settings: toml::Table,
}

/// The content of `failure.json`: why a cell failed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FailureRecord {
    /// The id of the cell.
    pub id: String,
    /// The error with its causes.
    pub reason: String,
    /// The program's version and the commit that it was built from.
    pub commit: String,
    /// Whether another attempt must restart the training, because resuming from the last checkpoint would fail in the
    /// same way.
    #[serde(rename = "begins_anew", default = "yes")]
    pub requires_restart: bool,
}

/// The default of [`FailureRecord::requires_restart`], for files of earlier programs without this field.
fn yes() -> bool {
    true
}

/// The content of `timing.json`: how long a cell took.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timing {
    /// Seconds from start to result, without interrupted attempts. Cells that share a process share its time: the
    /// seconds of all its cells add up to the time of the process.
    pub seconds: f64,
}

/// The reason why an experiment's folder cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum FolderError {
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is damaged, or was written in another format.
    #[error("{} is not understood: {reason}; delete it to run the cell again", path.display())]
    Damaged {
        path: PathBuf,
        /// Description of what is wrong in the file.
        reason: String,
    },
    /// The server's model of the environment differs from the model of a stored result.
    #[error(
        "cell {cell} was trained in {environment} with the model {trained}, but the server has {served}: serve the \
         task's original files, or choose another folder with --out"
    )]
    OtherModel { cell: String, environment: String, trained: String, served: String },
    /// Two results in one environment were trained with different models.
    #[error(
        "cells {cells:?} were trained in {environment} with different models, {hashes:?}, so their results cannot be \
         compared: delete the results of one model, and run these cells again"
    )]
    Models { environment: String, cells: Box<[String; 2]>, hashes: Box<[String; 2]> },
    /// The rows of a cell in a results table are invalid.
    #[error("the rows of cell {cell} are not understood: {reason}; export the cell's folder again")]
    Row {
        cell: String,
        /// Description of what is wrong in the rows.
        reason: String,
    },
    /// The folder has no `plan.toml`, so it holds no experiment.
    #[error(
        "{} holds no experiment: expected plan.toml in it; pass the folder that `perturb run --out` wrote",
        path.display()
    )]
    NoPlan { path: PathBuf },
}

type Result<T> = std::result::Result<T, FolderError>;

impl ExperimentFolder {
    /// Returns the folder at `path`, which need not exist.
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), new_heatmaps: None }
    }

    /// Sets the folder that new heatmaps are written to. Existing heatmaps are still read from the experiment's own
    /// folder `heatmaps`.
    pub fn with_new_heatmaps(self, path: PathBuf) -> Self {
        Self { new_heatmaps: Some(path), ..self }
    }

    /// Returns the path of the experiment's folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the folders that heatmaps are read from. New heatmaps are written to the first of them.
    pub fn heatmaps(&self) -> Vec<PathBuf> {
        self.new_heatmaps.iter().cloned().chain([self.path.join("heatmaps")]).collect()
    }

    /// Returns the folder of the cell with this id.
    pub fn cell(&self, id: &str) -> CellFolder {
        CellFolder { path: self.path.join("cells").join(id) }
    }

    /// Returns the path of the copy of the experiment file.
    pub fn plan_path(&self) -> PathBuf {
        self.path.join("plan.toml")
    }

    /// Returns the path of the copy of the experiment file if it exists.
    ///
    /// # Errors
    /// [`FolderError::NoPlan`] if the file does not exist.
    pub fn require_plan(&self) -> Result<PathBuf> {
        let plan = self.plan_path();
        if plan.is_file() { Ok(plan) } else { Err(FolderError::NoPlan { path: self.path.clone() }) }
    }

    /// Copies the experiment file and the CSV files that it names into the folder. Returns whether this replaced a
    /// different experiment file.
    ///
    /// # Errors
    /// [`FileError`] if a file cannot be read or written.
    pub fn store_plan(&self, plan: &Plan) -> files::Result<bool> {
        let earlier = files::read_if_exists(&self.plan_path())?;
        let same = earlier.as_deref() == Some(plan.text.as_bytes());
        for (name, content) in plan.files() {
            let path = self.path.join(name);
            if files::read_if_exists(&path)?.as_deref() != Some(content) {
                write_atomically(&path, content)?;
            }
        }
        Ok(earlier.is_some() && !same)
    }

    /// Checks that the server's `environment` has the same model as the stored results. Only the plan's first result in
    /// this environment is read, because [`Results::read`](crate::Results::read) already refuses results with different
    /// models.
    ///
    /// # Errors
    /// [`FolderError::OtherModel`] if the models differ, and the errors of [`CellFolder::state`].
    pub fn check_model(&self, plan: &Plan, environment: &proto::Environment) -> Result<()> {
        for cell in plan.cells.iter().filter(|cell| cell.config.common.environment == environment.name) {
            let place = self.cell(&cell.id);
            if !place.is_settled(false) {
                continue;
            }
            let CellState::Done(result) = place.state()? else { continue };
            let trained = result.training.model_hash;
            if trained == environment.model_hash {
                return Ok(());
            }
            let served = environment.model_hash.clone();
            return Err(FolderError::OtherModel {
                cell: result.id,
                environment: environment.name.clone(),
                trained,
                served,
            });
        }
        Ok(())
    }

    /// Returns the identity of every failure record in the folder by cell id, including cells that are in no plan.
    ///
    /// # Errors
    /// [`FileError`] if the folder cannot be read.
    pub fn failures(&self) -> files::Result<HashMap<String, FailureId>> {
        let places = files::list(&self.path.join("cells"))?.into_iter().map(|path| CellFolder { path });
        let marked = |place: CellFolder| {
            let id = place.path.file_name()?.to_str()?.to_owned();
            Some((id, place.failure_id()?))
        };
        Ok(places.filter_map(marked).collect())
    }
}

impl CellFolder {
    /// Returns the path of the cell's folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the folder of the training, as `perturb train --out` writes it.
    pub fn training(&self) -> PathBuf {
        self.path.join("training")
    }

    /// Returns the folder with the recorded episodes of the intermediate policy that was stored after `mark` training
    /// episodes.
    pub fn mark(&self, mark: u64) -> PathBuf {
        self.path.join("marks").join(mark.to_string())
    }

    /// Returns the path of the log with the warnings of the worker process that ran the cell. If the process ran
    /// several cells, only the log of the first one has the warnings, and the other logs refer to it.
    pub fn log(&self) -> PathBuf {
        self.path.join("log.txt")
    }

    /// Reads whether the cell is done, failed or neither, with its result or failure.
    ///
    /// # Errors
    /// [`FolderError`] if a file is there that cannot be read.
    pub fn state(&self) -> Result<CellState> {
        if let Some(result) = read::<CellResult>(&self.path.join("result.json"))? {
            if result.format_version != FORMAT_VERSION {
                let reason = format!("it has format {}, this program reads {FORMAT_VERSION}", result.format_version);
                return Err(FolderError::Damaged { path: self.path.join("result.json"), reason });
            }
            return Ok(CellState::Done(Box::new(result)));
        }
        Ok(read(&self.path.join("failure.json"))?.map_or(CellState::Missing, CellState::Failed))
    }

    /// Returns whether the cell has a result or, if `failed_too` is set, a failure. Only looks whether the files exist,
    /// and does not read them.
    pub fn is_settled(&self, failed_too: bool) -> bool {
        self.path.join("result.json").exists() || (failed_too && self.path.join("failure.json").exists())
    }

    /// Returns the identity of the failure record; `None` if there is none.
    pub fn failure_id(&self) -> Option<FailureId> {
        let file = fs::metadata(self.path.join("failure.json")).ok()?;
        Some(FailureId { inode: file.ino(), written: (file.mtime(), file.mtime_nsec()) })
    }

    /// Tries to lock the cell for this process. Returns `None` if another process holds the lock.
    ///
    /// # Errors
    /// [`FileError`] if the lock file cannot be created.
    pub fn try_lock(&self) -> files::Result<Option<Lock>> {
        files::create_folder(&self.path)?;
        Lock::try_take(&self.path)
    }

    /// Writes the result atomically.
    ///
    /// # Errors
    /// [`FileError`] if the file cannot be written.
    pub fn write_result(&self, result: &CellResult) -> files::Result<()> {
        write(&self.path.join("result.json"), result)
    }

    /// Writes the failure of the cell.
    ///
    /// # Errors
    /// [`FileError`] if the file cannot be written.
    pub fn write_failure(&self, failure: &FailureRecord) -> files::Result<()> {
        write(&self.path.join("failure.json"), failure)
    }

    /// Deletes the failure record. Also deletes the training that failed if another attempt [must restart
    /// it](FailureRecord::requires_restart), or if the record is damaged.
    ///
    /// # Errors
    /// [`FileError`] if the failure record cannot be read, in which case nothing is deleted, or if the training or the
    /// record cannot be deleted.
    pub fn clear_failure(&self) -> files::Result<()> {
        let path = self.path.join("failure.json");
        match read::<FailureRecord>(&path) {
            Ok(None) => return Ok(()),
            Ok(Some(FailureRecord { requires_restart: false, .. })) => {}
            Err(FolderError::File(error)) => return Err(error),
            Ok(Some(_)) | Err(_) => files::delete(&self.training())?,
        }
        files::delete(&path)
    }

    /// Deletes the failure record if its identity is still `expected`. Returns false, and deletes nothing, if another
    /// process has locked the cell.
    ///
    /// # Errors
    /// [`FileError`] if the lock file cannot be created, and the errors of [`CellFolder::clear_failure`].
    pub fn clear_failure_if(&self, expected: FailureId) -> files::Result<bool> {
        let lock = self.try_lock()?;
        if lock.is_some() && self.failure_id() == Some(expected) {
            self.clear_failure()?;
        }
        Ok(lock.is_some())
    }

    /// Writes the duration of the cell.
    ///
    /// # Errors
    /// [`FileError`] if the file cannot be written.
    pub fn write_timing(&self, timing: &Timing) -> files::Result<()> {
        files::write_json(&self.path.join("timing.json"), timing)
    }

    /// Returns the recorded duration of the cell; `None` if `timing.json` is missing or cannot be read.
    pub fn timing(&self) -> Option<Timing> {
        read(&self.path.join("timing.json")).ok().flatten()
    }
}

impl CellResult {
    /// The format version that this program reads and writes.
    pub const FORMAT_VERSION: u32 = FORMAT_VERSION;

    /// Returns the versions of all programs that contributed to the result, in order.
    pub fn commits(&self) -> impl Iterator<Item = &str> {
        self.earlier_commits.iter().chain([&self.commit]).map(String::as_str)
    }
}

/// Reads a JSON file, and verifies its checksum if it has one. Returns `None` if the file does not exist.
pub(crate) fn read<T: DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    let Some(text) = files::read_plain(path, MAX_BYTES)? else { return Ok(None) };
    let damaged = |reason: String| FolderError::Damaged { path: path.to_owned(), reason };
    let not_understood = |error: serde_json::Error| damaged(error.to_string());
    let mut value: Value = serde_json::from_slice(&text).map_err(not_understood)?;
    checksum::open(&mut value).map_err(|broken| damaged(broken.into()))?;
    serde_json::from_value(value).map(Some).map_err(not_understood)
}

/// Writes a JSON file that contains its own checksum.
fn write(path: &Path, record: &impl Serialize) -> files::Result<()> {
    let sealed = WithChecksum::new(record).map_err(|error| files::io("write", path)(error.into()))?;
    files::write_json(path, &sealed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use perturb_settings::Preset;

    fn result() -> CellResult {
        let test = TestResult {
            episodes: 10,
            success_percent: 100.0 / 3.0,
            success_percent_95: [0.1, 0.2],
            mean_return: -1.0 / 3.0,
            mean_length: 2.0,
        };
        CellResult {
            format_version: FORMAT_VERSION,
            id: "a".into(),
            training: Training {
                environment: "CartPole".into(),
                environment_revision: 1,
                model_hash: String::new(),
                version: Version::R,
                set: None,
                method: Method {
                    algorithm: "ppo".into(),
                    architecture: "ff".into(),
                    episodes_per_trial: None,
                    preset: Preset::Perturb,
                    observe: Default::default(),
                    external: false,
                },
                configuration: "00000000".into(),
                run: 2,
                seed: 8,
                counters: Counters { iterations: 1, timesteps: 2, episodes: 3, ..Counters::default() },
                settings: "learning_rate = 3e-4".parse().unwrap(),
            },
            results: BTreeMap::from([("D".to_owned(), test)]),
            marks: BTreeMap::new(),
            agreement: None,
            commit: "x".into(),
            earlier_commits: Vec::new(),
            command: "y".into(),
        }
    }

    #[test]
    fn a_result_reads_back_and_beats_a_failure() {
        let directory = tempfile::tempdir().unwrap();
        let cell = ExperimentFolder::new(directory.path()).cell("a");
        assert_eq!(cell.state().unwrap(), CellState::Missing);
        let failure =
            FailureRecord { id: "a".into(), reason: "NaN".into(), commit: "x".into(), requires_restart: true };
        cell.write_failure(&failure).unwrap();
        assert_eq!(cell.state().unwrap(), CellState::Failed(failure));
        assert!(cell.is_settled(true) && !cell.is_settled(false));
        cell.write_result(&result()).unwrap();
        assert_eq!(cell.state().unwrap(), CellState::Done(Box::new(result())));
        cell.clear_failure().unwrap();
        cell.clear_failure().unwrap();
        let names: Vec<_> = fs::read_dir(cell.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(names, ["result.json"], "nothing temporary stays");
    }

    #[test]
    fn training_is_deleted_only_with_numerical_failures() {
        let directory = tempfile::tempdir().unwrap();
        let cell = ExperimentFolder::new(directory.path()).cell("a");
        let earlier = r#"{"id": "a", "reason": "NaN", "commit": "x"}"#;
        for (failure, stays) in [
            (serde_json::json!({"id": "a", "reason": "another revision", "commit": "x", "begins_anew": false}), true),
            (serde_json::json!({"id": "a", "reason": "NaN", "commit": "x", "begins_anew": true}), false),
            (serde_json::from_str(earlier).unwrap(), false),
        ] {
            files::write_json(&cell.training().join("checkpoint.json"), &0).unwrap();
            files::write_json(&cell.path().join("failure.json"), &failure).unwrap();
            cell.clear_failure().unwrap();
            assert_eq!(cell.training().exists(), stays, "{failure}");
            assert_eq!(cell.failure_id(), None);
            cell.clear_failure().unwrap();
            assert_eq!(cell.training().exists(), stays, "there is nothing to forget any more");
        }
    }

    #[test]
    fn a_failure_recorded_again_is_another_one() {
        let directory = tempfile::tempdir().unwrap();
        let cell = ExperimentFolder::new(directory.path()).cell("a");
        let failure =
            FailureRecord { id: "a".into(), reason: "NaN".into(), commit: "x".into(), requires_restart: true };
        assert_eq!(cell.failure_id(), None);
        cell.write_failure(&failure).unwrap();
        let first = cell.failure_id().unwrap();
        assert_eq!(cell.failure_id(), Some(first));
        assert_eq!(serde_json::from_value::<FailureId>(serde_json::to_value(first).unwrap()).unwrap(), first);
        cell.write_failure(&failure).unwrap();
        assert_ne!(cell.failure_id(), Some(first));
        assert!(cell.clear_failure_if(first).unwrap() && cell.failure_id().is_some(), "it is another one");
        let lock = cell.try_lock().unwrap();
        assert!(!cell.clear_failure_if(cell.failure_id().unwrap()).unwrap() && cell.failure_id().is_some());
        drop(lock);
        assert!(cell.clear_failure_if(cell.failure_id().unwrap()).unwrap());
        assert_eq!(cell.failure_id(), None);
    }

    #[test]
    fn a_damaged_result_is_named_not_taken_for_missing() {
        let directory = tempfile::tempdir().unwrap();
        let cell = ExperimentFolder::new(directory.path()).cell("a");
        for (text, part) in [("{", "EOF"), ("{}", "missing field"), ("[]", "invalid")] {
            write_atomically(&cell.path().join("result.json"), text.as_bytes()).unwrap();
            let message = cell.state().unwrap_err().to_string();
            assert!(message.contains("a/result.json is not understood") && message.contains(part), "{message}");
        }
        cell.write_result(&CellResult { format_version: 9, ..result() }).unwrap();
        assert!(cell.state().unwrap_err().to_string().contains("it has format 9, this program reads 1"));
    }

    #[test]
    fn changed_result_is_refused_and_old_format_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let cell = ExperimentFolder::new(directory.path()).cell("a");
        cell.write_result(&result()).unwrap();
        let path = cell.path().join("result.json");
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replace("33.3", "93.3")).unwrap();
        let message = cell.state().unwrap_err().to_string();
        assert!(message.contains("result.json is not understood: the checksum does not match"), "{message}");
        assert!(message.ends_with("delete it to run the cell again"), "{message}");
        files::write_json(&path, &result()).unwrap();
        assert_eq!(cell.state().unwrap(), CellState::Done(Box::new(result())));
    }

    #[test]
    fn the_plan_is_kept_and_its_change_noticed() {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(&directory.path().join("new"));
        assert!(folder.require_plan().unwrap_err().to_string().contains("holds no experiment"));
        let plan = |environment: &str| {
            let text = format!("environments = ['{environment}']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']");
            Plan::parse("test", text).unwrap()
        };
        assert!(!folder.store_plan(&plan("One")).unwrap());
        assert!(!folder.store_plan(&plan("One")).unwrap());
        assert!(folder.store_plan(&plan("Two")).unwrap());
        assert_eq!(fs::read_to_string(folder.require_plan().unwrap()).unwrap(), plan("Two").text);
    }
}
