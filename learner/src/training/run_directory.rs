//! The directory of a training run, which one process at a time can lock.

use std::cell::{Cell, OnceCell};
use std::path::{Path, PathBuf};
use std::time::Duration;

use perturb_files::{self as files, FileError, Lock};
use perturb_text::quoted;

use crate::checkpoint::{Checkpoint, CheckpointError, ResumeState};

/// The directory of a training run. While this value exists and holds the lock, no other process can train in the
/// directory.
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    overwrite: bool,
    /// The lock of the directory. It is taken as soon as the directory exists.
    lock: OnceCell<Lock>,
    /// Whether the files in the directory belong to this run. Before [`RunDirectory::prepare`] they may belong to an
    /// earlier run.
    is_own: Cell<bool>,
}

/// The reason why a directory cannot be used for a training.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunDirectoryError {
    /// The path of a new run is a file.
    #[error("--out {} is a file; give a directory", path.display())]
    IsFile {
        /// The given path.
        path: PathBuf,
    },
    /// Another process is training in the directory.
    #[error("another process trains in {}; wait until it ends, or choose another directory", path.display())]
    Locked {
        /// The path of the directory.
        path: PathBuf,
    },
    /// The directory contains an earlier run, and `overwrite` is off.
    #[error(
        "{path} already holds a run ({file}): choose another --out, give --overwrite to delete that run, or resume it \
         with: perturb train --resume {}",
        quoted(path),
        path = path.display()
    )]
    HoldsRun {
        /// The path of the directory.
        path: PathBuf,
        /// The name of a file of the earlier run.
        file: String,
    },
    /// There is no such directory.
    #[error("--resume {}: there is no such directory; give the --out of a training", path.display())]
    Missing {
        /// The given path.
        path: PathBuf,
    },
    /// The path is a checkpoint inside a run, not the run's directory.
    #[error("{} is the checkpoint in a run; give the run's directory, which holds it", path.display())]
    IsCheckpoint {
        /// The given path.
        path: PathBuf,
    },
    /// The directory contains no run.
    #[error("{} holds no run; give the --out of a training", path.display())]
    NoRun {
        /// The given path.
        path: PathBuf,
    },
    /// The run ended before its first checkpoint.
    #[error(
        "the run in {path} ended before its first checkpoint, so there is nothing to resume; start again with perturb \
         train --out {} --overwrite and the same settings",
        quoted(path),
        path = path.display()
    )]
    NoCheckpoint {
        /// The path of the directory.
        path: PathBuf,
    },
    /// The checkpoint cannot be read or resumed.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
}

type Result<T> = std::result::Result<T, RunDirectoryError>;

impl RunDirectoryError {
    /// Returns whether the directory contains nothing that could ever be resumed.
    pub fn is_unrecoverable(&self) -> bool {
        match self {
            Self::Checkpoint(CheckpointError::Damaged { .. } | CheckpointError::NotResumable { .. })
            | Self::Missing { .. }
            | Self::NoRun { .. }
            | Self::NoCheckpoint { .. } => true,
            Self::Checkpoint(_)
            | Self::File(_)
            | Self::IsFile { .. }
            | Self::Locked { .. }
            | Self::HoldsRun { .. }
            | Self::IsCheckpoint { .. } => false,
        }
    }
}

impl RunDirectory {
    /// Chooses `path` as the directory of a new run. `overwrite` permits the deletion of an earlier run in it. Changes
    /// nothing yet: [`train`](crate::training::train) deletes the earlier run once the environments are open and all
    /// settings have been checked.
    ///
    /// # Errors
    /// [`RunDirectoryError`] if `path` is a file, if it contains a run and `overwrite` is off, or if another process is
    /// training in it.
    pub fn choose(path: &Path, overwrite: bool) -> Result<Self> {
        if path.exists() && !path.is_dir() {
            return Err(RunDirectoryError::IsFile { path: path.to_owned() });
        }
        let directory = Self::new(path, overwrite, false);
        if Lock::is_there(path) {
            directory.lock()?;
        } // a directory without a lock file is locked in `prepare`, because nothing may be created yet
        directory.earlier_run()?;
        Ok(directory)
    }

    /// Opens the run in `path` for resuming. Returns the locked directory, the last checkpoint and its resume state.
    ///
    /// # Errors
    /// [`RunDirectoryError`] if there is no run, no checkpoint, or a checkpoint that cannot be resumed, or if another
    /// process is training there.
    pub fn resume(path: &Path) -> Result<(Self, Checkpoint, ResumeState)> {
        if !files::metadata_if_exists(path)?.is_some_and(|metadata| metadata.is_dir()) {
            return Err(RunDirectoryError::Missing { path: path.to_owned() });
        }
        let directory = Self::new(path, false, true);
        // Locking would create a file, so the folder must first be recognised as a run.
        if !Lock::is_there(path) && !files::has_file(&directory.checkpoint().join("checkpoint.json"))? {
            return Err(directory.nothing_to_resume()?);
        }
        directory.lock()?;
        match ResumeState::load(&directory.checkpoint()) {
            Err(CheckpointError::Missing { .. }) => Err(directory.nothing_to_resume()?),
            loaded => loaded.map(|(checkpoint, state)| (directory, checkpoint, state)).map_err(Into::into),
        }
    }

    /// Returns a directory that is not locked yet.
    fn new(path: &Path, overwrite: bool, is_own: bool) -> Self {
        Self { path: path.to_owned(), overwrite, lock: OnceCell::new(), is_own: Cell::new(is_own) }
    }

    /// Returns the last checkpoint of this run; `None` if there is none yet.
    ///
    /// # Errors
    /// An error if the checkpoint cannot be read.
    pub(crate) fn last_checkpoint(&self) -> Result<Option<(Checkpoint, ResumeState)>> {
        if !self.is_own.get() {
            return Ok(None);
        }
        match ResumeState::load(&self.checkpoint()) {
            Err(CheckpointError::Missing { .. }) => Ok(None),
            loaded => Ok(Some(loaded?)),
        }
    }

    /// Finds out why there is no checkpoint, and returns the error to report.
    fn nothing_to_resume(&self) -> Result<RunDirectoryError> {
        let path = self.path.clone();
        Ok(if files::has_file(&path.join("checkpoint.json"))? {
            RunDirectoryError::IsCheckpoint { path }
        } else if files_of_a_run(&path)?.is_empty() {
            RunDirectoryError::NoRun { path }
        } else {
            RunDirectoryError::NoCheckpoint { path }
        })
    }

    /// Locks the directory against other processes.
    fn lock(&self) -> Result<()> {
        let lock = match Lock::try_take(&self.path)? {
            Some(lock) => Some(lock),
            None => {
                // Another process may have taken the lock for a moment, only to check it.
                std::thread::sleep(Duration::from_millis(20));
                Lock::try_take(&self.path)?
            }
        };
        let lock = lock.ok_or_else(|| RunDirectoryError::Locked { path: self.path.clone() })?;
        self.lock.get_or_init(|| lock);
        Ok(())
    }

    /// Returns the files of an earlier run. Returns an error if there are any and they must not be deleted.
    fn earlier_run(&self) -> Result<Vec<PathBuf>> {
        let files = files_of_a_run(&self.path)?;
        match files.first() {
            Some(file) if !self.overwrite && !self.is_own.get() => Err(RunDirectoryError::HoldsRun {
                path: self.path.clone(),
                file: file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            }),
            _ => Ok(files),
        }
    }

    /// Creates and locks the directory, and deletes an earlier run in it.
    pub(crate) fn prepare(&self) -> Result<()> {
        files::create_folder(&self.path)?;
        if self.lock.get().is_none() {
            self.lock()?;
        }
        self.earlier_run()?.iter().try_for_each(|file| files::delete(file))?;
        self.is_own.set(true);
        Ok(())
    }

    /// Returns the path of the directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the path of the last checkpoint.
    pub fn checkpoint(&self) -> PathBuf {
        self.path.join("checkpoint")
    }

    /// Returns the path of the intermediate policy that is saved after `mark` training episodes.
    pub fn mark(&self, mark: u64) -> PathBuf {
        mark_in(&self.path, mark)
    }

    /// Returns whether the intermediate policies of all `marks` exist.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn has_kept(&self, marks: impl Iterator<Item = u64>) -> Result<bool> {
        for mark in marks {
            if !files::has_file(&self.mark(mark).join("checkpoint.json"))? {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// Returns [`RunDirectory::mark`] of the run in `path`.
pub fn mark_in(path: &Path, mark: u64) -> PathBuf {
    path.join("marks").join(mark.to_string())
}

/// Returns the files in `path` that a training has written. Files with other names are not listed, so they are never
/// deleted.
fn files_of_a_run(path: &Path) -> files::Result<Vec<PathBuf>> {
    let mut paths = files::list(path)?;
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let known = ["config.toml", "progress.csv", "monitor.csv", "checkpoint", "marks"].contains(&name.as_ref());
        known || name.starts_with("events.out.tfevents.")
    });
    Ok(paths)
}
