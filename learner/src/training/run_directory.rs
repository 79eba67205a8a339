//! The directory of a run, locked for one process at a time.

use std::cell::{Cell, OnceCell};
use std::path::{Path, PathBuf};
use std::time::Duration;

use perturb_files::{self as files, FileError, Lock};
use perturb_text::quoted;

use crate::checkpoint::{Checkpoint, CheckpointError, ResumeState};

/// The directory of a run. As long as this value and its process live, no other process can train in the directory.
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    overwrite: bool,
    /// The lock of the directory, taken as soon as the directory exists.
    lock: OnceCell<Lock>,
    /// Whether the files in the directory are of this run. Files of an earlier run are there until
    /// [`RunDirectory::prepare`].
    is_own: Cell<bool>,
}

/// Why a directory cannot be trained in.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunDirectoryError {
    /// A new run cannot have the name of a file.
    #[error("--out {} is a file; give a directory", path.display())]
    IsFile {
        /// The path that was given.
        path: PathBuf,
    },
    /// Another process trains in the directory.
    #[error("another process trains in {}; wait until it ends, or choose another directory", path.display())]
    Locked {
        /// The directory.
        path: PathBuf,
    },
    /// A new run would delete an earlier one.
    #[error(
        "{path} already holds a run ({file}): choose another --out, give --overwrite to delete that run, or go on with \
         it: perturb train --resume {}",
        quoted(path),
        path = path.display()
    )]
    HoldsRun {
        /// The directory.
        path: PathBuf,
        /// A file of the run.
        file: String,
    },
    /// There is no such directory.
    #[error("--resume {}: there is no such directory; give the --out of a training", path.display())]
    Missing {
        /// The path that was given.
        path: PathBuf,
    },
    /// A checkpoint was given instead of its run.
    #[error("{} is the checkpoint in a run; give the run's directory, which holds it", path.display())]
    IsCheckpoint {
        /// The path that was given.
        path: PathBuf,
    },
    /// The directory holds no run.
    #[error("{} holds no run; give the --out of a training", path.display())]
    NoRun {
        /// The path that was given.
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
        /// The directory.
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
    /// Whether nothing can be resumed, now or later.
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
    /// Chooses `path` for a new run; if it holds an earlier run, `overwrite` allows its deletion. Changes nothing yet:
    /// [`train`](crate::training::train) empties the directory when the environments are open and all settings have
    /// proved to work.
    ///
    /// # Errors
    /// If it holds a run and `overwrite` is off; if another process trains in it; the operating system's.
    pub fn choose(path: &Path, overwrite: bool) -> Result<Self> {
        if path.exists() && !path.is_dir() {
            return Err(RunDirectoryError::IsFile { path: path.to_owned() });
        }
        let directory = Self::new(path, overwrite, false);
        if Lock::is_there(path) {
            directory.lock()?;
        } // otherwise it is locked when it is prepared: nothing may be created yet
        directory.earlier_run()?;
        Ok(directory)
    }

    /// Opens the run in `path` to resume it. Returns the policy and the state of its last checkpoint, too.
    ///
    /// # Errors
    /// If there is no run, no checkpoint, or one that cannot be resumed; if another process trains in it; the operating
    /// system's.
    pub fn resume(path: &Path) -> Result<(Self, Checkpoint, ResumeState)> {
        if !files::look(path)?.is_some_and(|metadata| metadata.is_dir()) {
            return Err(RunDirectoryError::Missing { path: path.to_owned() });
        }
        let directory = Self::new(path, false, true);
        // Locking creates a file, and this may be any folder.
        if !Lock::is_there(path) && !files::has_file(&directory.checkpoint().join("checkpoint.json"))? {
            return Err(directory.nothing_to_resume()?);
        }
        directory.lock()?;
        match ResumeState::load(&directory.checkpoint()) {
            Err(CheckpointError::Missing { .. }) => Err(directory.nothing_to_resume()?),
            loaded => loaded.map(|(checkpoint, state)| (directory, checkpoint, state)).map_err(Into::into),
        }
    }

    fn new(path: &Path, overwrite: bool, is_own: bool) -> Self {
        Self { path: path.to_owned(), overwrite, lock: OnceCell::new(), is_own: Cell::new(is_own) }
    }

    /// The last checkpoint of this value's run; `None` if there is none yet.
    ///
    /// # Errors
    /// A checkpoint that cannot be read.
    pub(crate) fn last_checkpoint(&self) -> Result<Option<(Checkpoint, ResumeState)>> {
        if !self.is_own.get() {
            return Ok(None);
        }
        match ResumeState::load(&self.checkpoint()) {
            Err(CheckpointError::Missing { .. }) => Ok(None),
            loaded => Ok(Some(loaded?)),
        }
    }

    /// The reason why there is no checkpoint.
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
                // Another process may have locked it only to look.
                std::thread::sleep(Duration::from_millis(20));
                Lock::try_take(&self.path)?
            }
        };
        let lock = lock.ok_or_else(|| RunDirectoryError::Locked { path: self.path.clone() })?;
        self.lock.get_or_init(|| lock);
        Ok(())
    }

    /// The files of an earlier run, which may be deleted.
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

    /// Creates the directory, or deletes the earlier run in it.
    pub(crate) fn prepare(&self) -> Result<()> {
        files::create_folder(&self.path)?;
        if self.lock.get().is_none() {
            self.lock()?;
        }
        self.earlier_run()?.iter().try_for_each(|file| files::delete(file))?;
        self.is_own.set(true);
        Ok(())
    }

    /// The path of the directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The path of the last checkpoint.
    pub fn checkpoint(&self) -> PathBuf {
        self.path.join("checkpoint")
    }

    /// The path of the checkpoint that a run kept for an intermediate evaluation after `mark` episodes of its budget.
    pub fn mark(&self, mark: u64) -> PathBuf {
        mark_in(&self.path, mark)
    }

    /// Whether the checkpoints of all `marks` exist.
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

/// [`RunDirectory::mark`] of the run in `path`.
pub fn mark_in(path: &Path, mark: u64) -> PathBuf {
    path.join("marks").join(mark.to_string())
}

/// The files in `path` that a run has written; others are left alone.
fn files_of_a_run(path: &Path) -> files::Result<Vec<PathBuf>> {
    let mut paths = files::list(path)?;
    paths.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let known = ["config.toml", "progress.csv", "monitor.csv", "checkpoint", "marks"].contains(&name.as_ref());
        known || name.starts_with("events.out.tfevents.")
    });
    Ok(paths)
}
