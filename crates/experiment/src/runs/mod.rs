//! The trainings and experiments below a folder: what is trained, how far it is, what came of it.

mod experiment;
mod progress;
mod training;

use std::path::{Path, PathBuf};

use serde::Serialize;

pub use self::experiment::{CellStatus, ExperimentStatus, LEADS_OUT};
pub use self::progress::{LastProgress, last_progress};
pub use self::training::TrainingStatus;
use perturb_files::{self as files, AnyError};

/// A run's `config.toml` or `plan.toml` is shorter, bytes.
const MAX_TEXT_BYTES: u64 = 16 << 20;

/// A folder that holds a run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RunFolder {
    /// The path of the folder.
    pub path: PathBuf,
    /// The kind of the run.
    pub kind: RunKind,
}

/// The kind of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RunKind {
    /// A training, as `perturb train --out` writes it.
    Training,
    /// An experiment, as `perturb run --out` writes it.
    Experiment,
}

impl RunKind {
    /// Detects the kind of the folder at `path`; `None` if it holds no run.
    pub fn detect(path: &Path) -> Option<Self> {
        if path.join("plan.toml").is_file() {
            Some(RunKind::Experiment)
        } else {
            path.join("config.toml").is_file().then_some(RunKind::Training)
        }
    }
}

/// Why nothing can be looked for in what is no folder, and what to do.
pub fn no_folder(path: &Path) -> String {
    format!("there is no folder {}: give the one that your runs are in", path.display())
}

/// The runs below a folder.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunFolders {
    /// The runs, in the order of their paths. Nothing is looked for in a run.
    pub runs: Vec<RunFolder>,
    /// All other folders, the first one itself among them.
    pub others: Vec<PathBuf>,
    /// Whether there are more folders than were looked at.
    pub more: bool,
}

/// Looks for runs in `folder`, in at most `most` folders. Symbolic links are not followed.
///
/// # Errors
/// The operating system's, of `folder` itself; what else cannot be listed is passed over.
pub fn places(folder: &Path, most: usize) -> files::Result<RunFolders> {
    let mut found = RunFolders::default();
    let mut left = vec![folder.to_owned()];
    files::require_folder(folder)?;
    while let Some(path) = left.pop() {
        if found.runs.len() + found.others.len() == most {
            found.more = true;
            break;
        }
        if let Some(kind) = RunKind::detect(&path) {
            found.runs.push(RunFolder { path, kind });
            continue;
        }
        let inner = files::list(&path).unwrap_or_default();
        left.extend(inner.into_iter().rev().filter(|inner| inner.is_dir() && !inner.is_symlink()));
        found.others.push(path);
    }
    Ok(found)
}

/// A training or an experiment in a few figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunSummary {
    /// The path of the folder.
    pub path: PathBuf,
    /// The trained method, or the environments of an experiment.
    pub what: String,
    /// Number of finished episodes of a training, or finished cells of an experiment.
    pub done: u64,
    /// Number of all these episodes or cells.
    pub budget: u64,
    /// "episodes" or "cells".
    pub unit: &'static str,
    /// Success: of the last 100 episodes of a training, or over the tests of the cells that are done.
    pub success_percent: Option<f64>,
    /// "in work", "finished", "broken off", …
    pub state: &'static str,
}

impl RunSummary {
    /// Reads the summary of the run in `place`. A run that cannot be read is "not understood".
    pub fn read(place: &RunFolder) -> Self {
        let read = || -> Result<Self, AnyError> {
            Ok(match place.kind {
                RunKind::Training => TrainingStatus::read(&place.path)?.summary(),
                RunKind::Experiment => ExperimentStatus::read(&place.path)?.summary(),
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
        std::os::unix::fs::symlink(path("b"), path("link")).unwrap();
        let found = places(directory.path(), 100).unwrap();
        let place = |name: &str, kind| RunFolder { path: path(name), kind };
        assert_eq!(found.runs, [place("a/deep", RunKind::Experiment), place("b", RunKind::Training)]);
        assert_eq!(found.others, [directory.path().to_owned(), path("a"), path("pictures")]);
        assert!(!found.more && places(directory.path(), 3).unwrap().more);
        assert_eq!(places(&path("b"), 9).unwrap().runs, [place("b", RunKind::Training)], "it may be a run itself");
        assert!(places(&path("missing"), 9).unwrap_err().to_string().contains("/missing"));
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
