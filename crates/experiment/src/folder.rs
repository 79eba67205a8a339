//! Where an experiment is kept.
//!
//! ```text
//! DIR/plan.toml              the experiment file
//! DIR/cells/ID/result.json   appears complete, when all is done
//! DIR/cells/ID/failure.json  why it failed
//! DIR/cells/ID/timing.json   how long it took; everything that differs from run to run
//! DIR/cells/ID/training/     what `perturb train --out` writes; marks/ in it, the policies of earlier moments
//! DIR/cells/ID/marks/        their recorded episodes
//! DIR/cells/ID/log.txt       warnings of worker processes
//! DIR/cells/ID/lock          locked while someone works on the cell
//! DIR/heatmaps/              what `perturb heatmap DIR` writes
//! DIR/report/                what `perturb report` writes
//! ```
//!
//! Every file appears complete.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use perturb_checkpoint::Counters;
use perturb_files::checksum::Sealed;
use perturb_files::{self as files, FileError, Lock, checksum, write_atomically};
use perturb_protocol::Version;
use perturb_records::{Agreement, TestResult};
use perturb_settings::Method;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::plan::{Cell, Plan};

/// Of `result.json`; raised when older programs could misread it.
const FORMAT_VERSION: u32 = 1;
/// A record of a cell is shorter, bytes.
const LONGEST: u64 = 64 << 20;

/// The folder of an experiment.
#[derive(Clone, Debug)]
pub struct Folder {
    path: PathBuf,
}

/// The folder of a cell.
#[derive(Clone, Debug)]
pub struct CellFolder {
    path: PathBuf,
}

/// Tells one record of a failure from the next, even if both say the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailureMark {
    /// The file's number, which another file may get when this one is deleted …
    inode: u64,
    /// … and when it was written, s and ns.
    written: (i64, i64),
}

/// How far a cell is.
#[derive(Clone, Debug, PartialEq)]
pub enum CellState {
    /// There is a result.
    Done(Box<CellResult>),
    /// It failed.
    Failed(Failure),
    /// Neither.
    Missing,
}

/// `result.json`: depends on the plan and the program alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellResult {
    /// Of this layout.
    pub format_version: u32,
    /// The cell.
    pub id: String,
    /// What was trained.
    pub training: Training,
    /// Success, return and length, by the name of the set that was tested: "D", "R", "E", "R+E" or one of the plan's
    /// own.
    pub results: BTreeMap<String, TestResult>,
    /// The same of the policies of earlier moments, by the episodes of the budget that mark these.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub marks: BTreeMap<u64, MarkResult>,
    /// How far requested and applied parameters agreed in the tests; `None` in results of earlier programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub agreement: Option<Agreement>,
    /// The program's version and the commit that it was built from.
    pub commit: String,
    /// Other programs that did a part of the training before it was broken off, in order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub earlier_commits: Vec<String>,
    /// What gives the same numbers again without the plan.
    pub command: String,
}

/// Tests of the policy of an earlier moment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkResult {
    /// How long the training had become: to the end of the iteration in which the mark was passed.
    pub counters: Counters,
    /// As those of the cell.
    pub results: BTreeMap<String, TestResult>,
    /// How far requested and applied parameters agreed.
    pub agreement: Agreement,
}

/// What was trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Training {
    /// By its name in the catalogue.
    pub environment: String,
    /// As the server told it: a change of dynamics raises it.
    pub environment_revision: u32,
    /// SHA-256 of its model; empty without one.
    pub model_hash: String,
    /// Where parameters came from, but for those that the settings name.
    pub version: Version,
    /// The name of the plan's own set of parameters, if it was trained on one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub set: Option<String>,
    /// What learned.
    #[serde(flatten)]
    pub method: Method,
    /// Names the settings.
    pub configuration: String,
    /// The run, from 1.
    pub run: u32,
    /// Of the training and of the tests.
    pub seed: u64,
    /// How long it became.
    pub counters: Counters,
    /// All settings, as in `config.toml`.
    pub settings: toml::Table,
}

/// `failure.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Failure {
    /// The cell.
    pub id: String,
    /// The error with its causes.
    pub reason: String,
    /// The program's version and the commit that it was built from.
    pub commit: String,
    /// Whether another attempt must begin anew: from its last checkpoint the training would come to the same.
    #[serde(default = "yes")]
    pub begins_anew: bool,
}

/// What earlier programs meant.
fn yes() -> bool {
    true
}

/// `timing.json`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timing {
    /// Seconds from the beginning to the result, without what an attempt took that was broken off. Where a process does
    /// several cells at a time, each moment counts as its part of it: the seconds of all cells add up to the process's.
    pub seconds: f64,
}

/// Why an experiment's folder cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum FolderError {
    /// The operating system refused a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is damaged, or of a program that is too different.
    #[error("{} is not understood: {reason}; delete it to have the cell done again", path.display())]
    Damaged {
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// There is no experiment.
    #[error("{} holds no experiment: expected plan.toml in it; give the --out of `perturb run`", path.display())]
    NoPlan { path: PathBuf },
}

type Result<T> = std::result::Result<T, FolderError>;

impl Folder {
    /// The folder at `path`, which need not exist.
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned() }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The folder of a cell.
    pub fn cell(&self, id: &str) -> CellFolder {
        CellFolder { path: self.path.join("cells").join(id) }
    }

    /// The copy of the experiment file.
    pub fn plan_path(&self) -> PathBuf {
        self.path.join("plan.toml")
    }

    /// The copy of the experiment file, which must be there.
    ///
    /// # Errors
    /// [`FolderError::NoPlan`].
    pub fn require_plan(&self) -> Result<PathBuf> {
        let plan = self.plan_path();
        if plan.is_file() { Ok(plan) } else { Err(FolderError::NoPlan { path: self.path.clone() }) }
    }

    /// Keeps a copy of the experiment file, with the files that it names; says whether there was another one.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn keep_plan(&self, plan: &Plan) -> files::Result<bool> {
        let earlier = files::read_if_there(&self.plan_path())?;
        let same = earlier.as_deref() == Some(plan.text.as_bytes());
        for (name, content) in plan.files() {
            let path = self.path.join(name);
            if files::read_if_there(&path)?.as_deref() != Some(content) {
                write_atomically(&path, content)?;
            }
        }
        Ok(earlier.is_some() && !same)
    }

    /// Which records of failures there are, by the cells' ids, whatever plan has them.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn failures(&self) -> files::Result<HashMap<String, FailureMark>> {
        let places = files::list(&self.path.join("cells"))?.into_iter().map(|path| CellFolder { path });
        let marked = |place: CellFolder| {
            let id = place.path.file_name()?.to_str()?.to_owned();
            Some((id, place.failure_mark()?))
        };
        Ok(places.filter_map(marked).collect())
    }

    /// How far `cell` is.
    ///
    /// # Errors
    /// [`FolderError`] if a file is there that cannot be read.
    pub fn state(&self, cell: &Cell) -> Result<CellState> {
        self.cell(&cell.id).state()
    }
}

impl CellFolder {
    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What `perturb train --out` writes.
    pub fn training(&self) -> PathBuf {
        self.path.join("training")
    }

    /// Where the recorded episodes of the policy of an earlier moment are.
    pub fn mark(&self, mark: u64) -> PathBuf {
        self.path.join("marks").join(mark.to_string())
    }

    /// What a worker process said.
    pub fn log(&self) -> PathBuf {
        self.path.join("log.txt")
    }

    /// How far the cell is.
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

    /// Whether there is a result or, unless `failed_too` is off, a failure. Reads neither.
    pub fn is_settled(&self, failed_too: bool) -> bool {
        self.path.join("result.json").exists() || (failed_too && self.path.join("failure.json").exists())
    }

    /// Which record of a failure there is; `None` if there is none.
    pub fn failure_mark(&self) -> Option<FailureMark> {
        let file = fs::metadata(self.path.join("failure.json")).ok()?;
        Some(FailureMark { inode: file.ino(), written: (file.mtime(), file.mtime_nsec()) })
    }

    /// Tries to become the one who works on the cell; `None` while somebody else does.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn try_lock(&self) -> files::Result<Option<Lock>> {
        files::create_folder(&self.path)?;
        Lock::try_take(&self.path.join("lock"))
    }

    /// Makes the result appear, complete.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write_result(&self, result: &CellResult) -> files::Result<()> {
        write(&self.path.join("result.json"), result)
    }

    /// Records a failure.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write_failure(&self, failure: &Failure) -> files::Result<()> {
        write(&self.path.join("failure.json"), failure)
    }

    /// Forgets a failure, and the training that led to it if another attempt [must begin anew](Failure::begins_anew).
    ///
    /// # Errors
    /// [`FileError`]; nothing was forgotten then.
    pub fn forget_failure(&self) -> files::Result<()> {
        let path = self.path.join("failure.json");
        match read::<Failure>(&path) {
            Ok(None) => return Ok(()),
            Ok(Some(Failure { begins_anew: false, .. })) => {}
            Err(FolderError::File(error)) => return Err(error),
            Ok(Some(_)) | Err(_) => files::delete(&self.training())?,
        }
        files::delete(&path)
    }

    /// Forgets the failure `mark`, and no other. Says whether that was possible: not while somebody works on the cell.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn forgive(&self, mark: FailureMark) -> files::Result<bool> {
        let lock = self.try_lock()?;
        if lock.is_some() && self.failure_mark() == Some(mark) {
            self.forget_failure()?;
        }
        Ok(lock.is_some())
    }

    /// Records how long the cell took.
    ///
    /// # Errors
    /// [`FileError`].
    pub fn write_timing(&self, timing: &Timing) -> files::Result<()> {
        files::write_json(&self.path.join("timing.json"), timing)
    }

    /// How long the cell took; `None` if that is not known.
    pub fn timing(&self) -> Option<Timing> {
        read(&self.path.join("timing.json")).ok().flatten()
    }
}

impl CellResult {
    /// The layout that this program writes.
    pub const FORMAT_VERSION: u32 = FORMAT_VERSION;

    /// All programs that it comes from, in order.
    pub fn commits(&self) -> impl Iterator<Item = &str> {
        self.earlier_commits.iter().chain([&self.commit]).map(String::as_str)
    }
}

/// A JSON file, whose checksum is the right one, if it has any; `None` if it is not there.
pub(crate) fn read<T: DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    let Some(text) = files::read_plain(path, LONGEST)? else { return Ok(None) };
    let damaged = |reason: String| FolderError::Damaged { path: path.to_owned(), reason };
    let not_understood = |error: serde_json::Error| damaged(error.to_string());
    let mut value: Value = serde_json::from_slice(&text).map_err(not_understood)?;
    checksum::open(&mut value).map_err(|broken| damaged(broken.into()))?;
    serde_json::from_value(value).map(Some).map_err(not_understood)
}

/// Writes a record with its checksum.
fn write(path: &Path, record: &impl Serialize) -> files::Result<()> {
    let sealed = Sealed::new(record).map_err(|error| files::io("write", path)(error.into()))?;
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
                    elsewhere: false,
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
        let cell = Folder::new(directory.path()).cell("a");
        assert_eq!(cell.state().unwrap(), CellState::Missing);
        let failure = Failure { id: "a".into(), reason: "NaN".into(), commit: "x".into(), begins_anew: true };
        cell.write_failure(&failure).unwrap();
        assert_eq!(cell.state().unwrap(), CellState::Failed(failure));
        assert!(cell.is_settled(true) && !cell.is_settled(false));
        cell.write_result(&result()).unwrap();
        assert_eq!(cell.state().unwrap(), CellState::Done(Box::new(result())));
        cell.forget_failure().unwrap();
        cell.forget_failure().unwrap();
        let names: Vec<_> = fs::read_dir(cell.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(names, ["result.json"], "nothing temporary stays");
    }

    #[test]
    fn what_was_trained_is_forgotten_with_a_failure_of_its_numbers_only() {
        let directory = tempfile::tempdir().unwrap();
        let cell = Folder::new(directory.path()).cell("a");
        let earlier = r#"{"id": "a", "reason": "NaN", "commit": "x"}"#;
        for (failure, stays) in [
            (serde_json::json!({"id": "a", "reason": "another revision", "commit": "x", "begins_anew": false}), true),
            (serde_json::json!({"id": "a", "reason": "NaN", "commit": "x", "begins_anew": true}), false),
            (serde_json::from_str(earlier).unwrap(), false),
        ] {
            files::write_json(&cell.training().join("checkpoint.json"), &0).unwrap();
            files::write_json(&cell.path().join("failure.json"), &failure).unwrap();
            cell.forget_failure().unwrap();
            assert_eq!(cell.training().exists(), stays, "{failure}");
            assert_eq!(cell.failure_mark(), None);
            cell.forget_failure().unwrap();
            assert_eq!(cell.training().exists(), stays, "there is nothing to forget any more");
        }
    }

    #[test]
    fn a_failure_recorded_again_is_another_one() {
        let directory = tempfile::tempdir().unwrap();
        let cell = Folder::new(directory.path()).cell("a");
        let failure = Failure { id: "a".into(), reason: "NaN".into(), commit: "x".into(), begins_anew: true };
        assert_eq!(cell.failure_mark(), None);
        cell.write_failure(&failure).unwrap();
        let first = cell.failure_mark().unwrap();
        assert_eq!(cell.failure_mark(), Some(first));
        assert_eq!(serde_json::from_value::<FailureMark>(serde_json::to_value(first).unwrap()).unwrap(), first);
        cell.write_failure(&failure).unwrap();
        assert_ne!(cell.failure_mark(), Some(first));
        assert!(cell.forgive(first).unwrap() && cell.failure_mark().is_some(), "it is another one");
        let lock = cell.try_lock().unwrap();
        assert!(!cell.forgive(cell.failure_mark().unwrap()).unwrap() && cell.failure_mark().is_some());
        drop(lock);
        assert!(cell.forgive(cell.failure_mark().unwrap()).unwrap());
        assert_eq!(cell.failure_mark(), None);
    }

    #[test]
    fn a_damaged_result_is_named_not_taken_for_missing() {
        let directory = tempfile::tempdir().unwrap();
        let cell = Folder::new(directory.path()).cell("a");
        for (text, part) in [("{", "EOF"), ("{}", "missing field"), ("[]", "invalid")] {
            write_atomically(&cell.path().join("result.json"), text.as_bytes()).unwrap();
            let message = cell.state().unwrap_err().to_string();
            assert!(message.contains("a/result.json is not understood") && message.contains(part), "{message}");
        }
        cell.write_result(&CellResult { format_version: 9, ..result() }).unwrap();
        assert!(cell.state().unwrap_err().to_string().contains("it has format 9, this program reads 1"));
    }

    #[test]
    fn a_changed_digit_of_a_result_is_refused_and_one_of_an_earlier_program_read() {
        let directory = tempfile::tempdir().unwrap();
        let cell = Folder::new(directory.path()).cell("a");
        cell.write_result(&result()).unwrap();
        let path = cell.path().join("result.json");
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replace("33.3", "93.3")).unwrap();
        let message = cell.state().unwrap_err().to_string();
        assert!(message.contains("result.json is not understood: it is not what was written"), "{message}");
        assert!(message.ends_with("delete it to have the cell done again"), "{message}");
        files::write_json(&path, &result()).unwrap();
        assert_eq!(cell.state().unwrap(), CellState::Done(Box::new(result())));
    }

    #[test]
    fn the_plan_is_kept_and_its_change_noticed() {
        let directory = tempfile::tempdir().unwrap();
        let folder = Folder::new(&directory.path().join("new"));
        assert!(folder.require_plan().unwrap_err().to_string().contains("holds no experiment"));
        let plan = |environment: &str| {
            let text = format!("environments = ['{environment}']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']");
            Plan::parse("test", text).unwrap()
        };
        assert!(!folder.keep_plan(&plan("One")).unwrap());
        assert!(!folder.keep_plan(&plan("One")).unwrap());
        assert!(folder.keep_plan(&plan("Two")).unwrap());
        assert_eq!(fs::read_to_string(folder.require_plan().unwrap()).unwrap(), plan("Two").text);
    }
}
