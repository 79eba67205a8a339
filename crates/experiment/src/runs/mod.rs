//! Finds the trainings, experiments and saved assessments below a folder, and reads their progress and success.

mod assessment;
mod experiment;
mod progress;
mod training;

use std::collections::{HashSet, VecDeque};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};

pub use self::assessment::AssessmentStatus;
pub use self::experiment::{CellStatus, ExperimentStatus, LEADS_OUT};
pub use self::progress::{LastProgress, last_progress};
pub use self::training::TrainingStatus;
use perturb_files::{self as files, AnyError, escapes_root};
use perturb_records::ExternalEvaluation;

/// Maximum number of folders that are searched behind symbolic links, because a link may lead to a whole disk.
const MAX_FOLDERS_BEHIND_LINKS: usize = 10_000;

/// A folder that contains a run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RunFolder {
    /// The path of the folder.
    pub path: PathBuf,
    /// The kind of the run.
    pub kind: RunKind,
}

/// A kind of run. Folders of different kinds have different layouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RunKind {
    /// A training, as `perturb train --out` writes it.
    Training,
    /// An experiment, as `perturb run --out` writes it.
    Experiment,
    /// An assessment, as `Assessment.save` of the Python package writes it.
    Assessment,
}

impl RunKind {
    /// Detects the kind of run in the folder at `path`; `None` if the folder contains no run.
    pub fn detect(path: &Path) -> Option<Self> {
        if path.join("plan.toml").is_file() {
            Some(RunKind::Experiment)
        } else if path.join("config.toml").is_file() {
            Some(RunKind::Training)
        } else {
            ExternalEvaluation::is_in(path).then_some(RunKind::Assessment)
        }
    }
}

/// Returns the error message for a `path` that is not a folder.
pub fn no_folder(path: &Path) -> String {
    format!("there is no folder {}: pass the folder that contains your runs", path.display())
}

/// The result of a search for runs below a folder.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunFolders {
    /// The runs, ordered by path. Folders inside a run are not searched.
    pub runs: Vec<RunFolder>,
    /// All other searched folders, including the one where the search starts if it is no run itself.
    pub others: Vec<PathBuf>,
    /// Symbolic links that were not followed because they lead out of the folder `within`, or to a hidden folder in it.
    pub links_out: Vec<PathBuf>,
    /// Whether the search stopped at its maximum number of folders, so that runs may be missing.
    pub more: bool,
}

/// Finds runs in `folder` and its subfolders. Searches at most `most` folders, each once. Follows symbolic links after
/// it has searched all other folders. If `within` is given, does not follow links that lead out of this folder or to a
/// hidden folder in it. `within` must be an absolute path without links.
///
/// # Errors
/// Errors of the operating system if `folder` itself cannot be listed. Skips other folders that cannot be listed.
pub fn places(folder: &Path, most: usize, within: Option<&Path>) -> files::Result<RunFolders> {
    let mut found = RunFolders::default();
    let mut search = FolderSearch::default();
    let mut left = vec![folder.to_owned()];
    files::require_folder(folder)?;
    loop {
        // Follows a symbolic link only when no other folders are left.
        let Some(path) = left.pop() else {
            let Some(link) = search.links.pop_front() else { break };
            let parent = link.parent().unwrap_or(folder);
            match within.filter(|root| escapes_root(root, parent, link.file_name().unwrap_or_default())) {
                Some(_) => found.links_out.push(link),
                None if search.followed == MAX_FOLDERS_BEHIND_LINKS => found.more = true,
                None => {
                    search.is_behind_link = true;
                    left.push(link);
                }
            }
            continue;
        };
        if !search.is_new(&path) {
            continue;
        }
        if found.runs.len() + found.others.len() == most || search.followed == MAX_FOLDERS_BEHIND_LINKS {
            found.more = true;
            break;
        }
        // A folder that contains a run is not searched for further runs. Any other folder is searched.
        if let Some(kind) = RunKind::detect(&path) {
            found.runs.push(RunFolder { path, kind });
            continue;
        }
        let (links, inner): (Vec<_>, Vec<_>) = files::list(&path)
            .unwrap_or_default()
            .into_iter()
            .filter(|inner| inner.is_dir())
            .partition(|inner| inner.is_symlink());
        left.extend(inner.into_iter().rev());
        search.links.extend(links);
        found.others.push(path);
    }
    found.runs.sort();
    found.others.sort();
    found.links_out.sort();
    Ok(found)
}

/// The state of a search for runs, see [`places`].
#[derive(Default)]
struct FolderSearch {
    /// Symbolic links to folders that have not been followed yet.
    links: VecDeque<PathBuf>,
    /// Device and inode of each searched folder, so that no folder is searched twice.
    seen: HashSet<(u64, u64)>,
    is_behind_link: bool,
    /// Number of folders that were searched behind links.
    followed: usize,
}

impl FolderSearch {
    /// Marks a folder as searched. Returns false if it was already searched, or cannot be read.
    fn is_new(&mut self, path: &Path) -> bool {
        let Ok(metadata) = path.metadata() else { return false };
        let is_new = self.seen.insert((metadata.dev(), metadata.ino()));
        self.followed += usize::from(is_new && self.is_behind_link);
        is_new
    }
}

/// The progress and success of a training, an experiment or an assessment, for a list of runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunSummary {
    /// The path of the folder. In JSON, U+FFFD replaces bytes that are not UTF-8.
    #[serde(serialize_with = "as_text")]
    pub path: PathBuf,
    /// A description: environment and method of a training, environments of an experiment, or environment and agent of
    /// an assessment.
    pub what: String,
    /// Number of finished episodes of a training or an assessment, or finished cells of an experiment.
    pub done: u64,
    /// Total number of episodes or cells, in the unit of `done`.
    pub budget: u64,
    /// The unit of `done` and `budget`: "episodes" or "cells".
    pub unit: &'static str,
    /// Success rate, %: of the last 100 episodes of a training, or the mean over all tests of an assessment or of the
    /// finished cells of an experiment. `None` if there is none yet.
    pub success_percent: Option<f64>,
    /// The state: "in work", "finished", "broken off", "with failures", "without a checkpoint", "assessed" or "not
    /// understood".
    pub state: &'static str,
}

/// Serializes a path as text, with replacement characters if it is not UTF-8. serde's serialization of paths would fail
/// for such a path, and then the whole document could not be written.
fn as_text<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}

impl RunSummary {
    /// Reads the summary of the run in `place`. If the run cannot be read, its state is "not understood".
    pub fn read(place: &RunFolder) -> Self {
        let read = || -> Result<Self, AnyError> {
            Ok(match place.kind {
                RunKind::Training => TrainingStatus::read(&place.path)?.summary(),
                RunKind::Experiment => ExperimentStatus::read(&place.path)?.summary(),
                RunKind::Assessment => AssessmentStatus::read(&place.path)?.summary(),
            })
        };
        read().unwrap_or_else(|_| Self::not_understood(&place.path))
    }

    /// Returns the summary of a run that cannot be read.
    pub fn not_understood(path: &Path) -> Self {
        let (what, state) = (String::new(), "not understood");
        Self { path: path.to_owned(), what, done: 0, budget: 0, unit: "", success_percent: None, state }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use perturb_files::write_atomically;

    #[test]
    fn runs_are_found_at_any_depth_but_not_inside_runs() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        for name in ["b/config.toml", "a/deep/plan.toml", "a/deep/cells/x/training/config.toml", "pictures/one.svg"] {
            write_atomically(&path(name), b"").unwrap();
        }
        let found = places(directory.path(), 100, None).unwrap();
        let place = |name: &str, kind| RunFolder { path: path(name), kind };
        assert_eq!(found.runs, [place("a/deep", RunKind::Experiment), place("b", RunKind::Training)]);
        assert_eq!(found.others, [directory.path().to_owned(), path("a"), path("pictures")]);
        assert!(!found.more && places(directory.path(), 3, None).unwrap().more);
        assert_eq!(
            places(&path("b"), 9, None).unwrap().runs,
            [place("b", RunKind::Training)],
            "it may be a run itself"
        );
        assert!(places(&path("missing"), 9, None).unwrap_err().to_string().contains("/missing"));
    }

    #[test]
    fn links_are_followed_once_and_not_out_of_a_root() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().canonicalize().unwrap();
        let path = |name: &str| root.join(name);
        for name in ["runs/b/config.toml", "scratch/big/config.toml", "scratch/more/c/config.toml"] {
            write_atomically(&path(name), b"").unwrap();
        }
        let links =
            [("runs/a", "b"), ("runs/big", "../scratch/big"), ("runs/loop", "."), ("runs/more", "../scratch/more")];
        for (name, to) in links.into_iter().chain([("runs/nowhere", "nothing")]) {
            std::os::unix::fs::symlink(to, path(name)).unwrap();
        }
        let paths = |runs: Vec<RunFolder>| runs.into_iter().map(|run| run.path).collect::<Vec<_>>();
        let found = places(&path("runs"), 100, None).unwrap();
        assert_eq!(paths(found.runs), [path("runs/b"), path("runs/big"), path("runs/more/c")]);
        assert!(found.links_out.is_empty() && !found.more);
        let found = places(&path("runs"), 100, Some(&path("runs"))).unwrap();
        assert_eq!(paths(found.runs), [path("runs/b")]);
        assert_eq!(found.links_out, [path("runs/big"), path("runs/more")]);
    }

    #[test]
    fn a_path_that_is_not_text_hides_no_other_run() {
        let name = std::os::unix::ffi::OsStrExt::from_bytes(b"latin\xfc");
        let summary = RunSummary::not_understood(Path::new::<std::ffi::OsStr>(name));
        assert!(serde_json::to_string(&[summary]).unwrap().contains("\"path\":\"latin\u{fffd}\""));
    }

    #[test]
    fn a_run_that_cannot_be_read_is_listed_as_such() {
        let directory = tempfile::tempdir().unwrap();
        for (name, kind) in [("config.toml", RunKind::Training), ("plan.toml", RunKind::Experiment)] {
            let path = directory.path().join(name.replace('.', "-"));
            write_atomically(&path.join(name), b"no TOML").unwrap();
            let summary = RunSummary::read(&RunFolder { path: path.clone(), kind });
            assert_eq!(summary, RunSummary::not_understood(&path));
        }
    }
}
