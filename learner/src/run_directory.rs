//! The directory of a run: for one process at a time.

use std::cell::OnceCell;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::checkpoint::{Checkpoint, CheckpointError, ResumeState};

/// The directory of a run. While this value lives, and its process with it, no other process can train in there.
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    overwrite: bool,
    /// Open and locked as soon as the directory exists. The kernel unlocks it when the process ends, however it ends.
    lock: OnceCell<File>,
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
            bail!("--out {} is a file; give a directory", path.display());
        }
        let directory = Self { path: path.to_owned(), overwrite, lock: OnceCell::new() };
        if path.exists() {
            directory.lock()?;
        }
        directory.earlier_run()?;
        Ok(directory)
    }

    /// Opens the run in `path` to go on with it, with the policy and the state of its last checkpoint.
    ///
    /// # Errors
    /// If there is no run, no checkpoint, or one that cannot be resumed; if another process trains in it; the operating
    /// system's.
    pub fn resume(path: &Path) -> Result<(Self, Checkpoint, ResumeState)> {
        if !path.is_dir() {
            bail!("--resume {}: there is no such directory; give the --out of a training", path.display());
        }
        let directory = Self { path: path.to_owned(), overwrite: false, lock: OnceCell::new() };
        directory.lock()?;
        let loaded = match Checkpoint::load_with_resume(&directory.checkpoint()) {
            Err(CheckpointError::Missing { .. }) => Err(directory.nothing_to_resume()?),
            loaded => Ok(loaded?),
        };
        let (checkpoint, resume) = loaded?;
        Ok((directory, checkpoint, resume))
    }

    /// Why there is no checkpoint.
    fn nothing_to_resume(&self) -> Result<anyhow::Error> {
        let shown = self.path.display();
        Ok(if self.path.join("checkpoint.json").is_file() {
            anyhow::anyhow!("{shown} is the checkpoint in a run; give the run's directory, which holds it")
        } else if files_of_a_run(&self.path)?.is_empty() {
            anyhow::anyhow!("{shown} holds no run; give the --out of a training")
        } else {
            anyhow::anyhow!(
                "the run in {shown} ended before its first checkpoint, so there is nothing to resume; start again with \
                 perturb train --out {shown} --overwrite and the same settings"
            )
        })
    }

    /// Keeps other processes out.
    fn lock(&self) -> Result<()> {
        let shown = self.path.display();
        let file = File::open(&self.path).with_context(|| format!("cannot open {shown}"))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                bail!("another process trains in {shown}; wait until it ends, or choose another directory")
            }
            Err(TryLockError::Error(error)) => {
                return Err(error).with_context(|| format!("cannot lock {shown}"));
            }
        }
        self.lock.get_or_init(|| file);
        Ok(())
    }

    /// The files of an earlier run, which may be deleted.
    fn earlier_run(&self) -> Result<Vec<PathBuf>> {
        let files = files_of_a_run(&self.path)?;
        if let (Some(file), false) = (files.first(), self.overwrite) {
            bail!(
                "{} already holds a run ({}): choose another --out, give --overwrite to delete that run, or go on with \
                 it: perturb train --resume {}",
                self.path.display(),
                file.file_name().unwrap_or_default().to_string_lossy(),
                self.path.display()
            );
        }
        Ok(files)
    }

    /// Creates it, or empties it of the earlier run.
    pub(crate) fn prepare(&self) -> Result<()> {
        let path = &self.path;
        fs::create_dir_all(path).with_context(|| format!("cannot create {}", path.display()))?;
        if self.lock.get().is_none() {
            self.lock()?;
        }
        for file in self.earlier_run()? {
            let removed = if file.is_dir() { fs::remove_dir_all(&file) } else { fs::remove_file(&file) };
            removed.with_context(|| format!("cannot delete {}", file.display()))?;
        }
        Ok(())
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where its checkpoint is.
    pub fn checkpoint(&self) -> PathBuf {
        self.path.join("checkpoint")
    }
}

/// What a run has written in `path`; other files are left alone.
fn files_of_a_run(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let mut files = Vec::new();
    for entry in fs::read_dir(path).with_context(|| format!("cannot list {}", path.display()))? {
        let entry = entry.with_context(|| format!("cannot list {}", path.display()))?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let known = ["config.toml", "progress.csv", "monitor.csv", "checkpoint"].contains(&name.as_ref());
        if known || name.starts_with("events.out.tfevents.") {
            files.push(entry.path());
        }
    }
    files.sort();
    Ok(files)
}
