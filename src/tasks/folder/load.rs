//! Loads a folder into memory, where it stays until the process ends.

use super::{
    environment::{FolderEnvironment, FolderTask},
    error::Error,
    file,
    files::Files,
    mjcf,
};
use crate::env::{self, EnvironmentSpec, disturbance};
use std::{fmt, path::Path, sync::OnceLock};

/// A handle to a loaded folder. The folder stays in memory until the process ends, because environments, catalogues and
/// sessions refer to it.
#[derive(Clone, Copy)]
pub struct TaskFolder {
    pub(super) task: &'static FolderTask,
    spec: &'static EnvironmentSpec,
    pub(super) files: &'static Files,
}

impl TaskFolder {
    /// The description of the environment. If the file configures values of a disturbance in versions R and E, all
    /// disturbances are among the parameters.
    pub fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    /// Whether the files on the disk still have the loaded contents.
    pub fn is_unchanged(&self) -> bool {
        self.files.have_unchanged_times()
    }
}

impl fmt::Debug for TaskFolder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TaskFolder").field("name", &self.task.spec.name).finish_non_exhaustive()
    }
}

/// Loads a folder. The folder stays in memory until the process ends, because sessions refer to it.
///
/// MuJoCo may abort the process or use all its memory for a bad model. Call [`check`](super::child::check) first for a
/// folder that is new.
///
/// # Errors
/// [`Error`] with the file, the line and what to do.
pub fn load(folder: &Path) -> Result<TaskFolder, Error> {
    let mut files = Files::open(folder)?;
    let task = file::read(&mut files)?;
    if !files.are_unchanged() {
        return Err(Error::folder("the files changed while they were loaded; load the folder again"));
    }
    let files: &'static Files = Box::leak(Box::new(files));
    let task: &'static mut FolderTask = Box::leak(Box::new(task));
    // The task contains the spec, whose closure refers to the task. So the closure reads the task's address from a
    // cell, which is set below.
    let address: &'static OnceLock<&'static FolderTask> = Box::leak(Box::default());
    task.spec.make = Box::leak(Box::new(move || match address.get() {
        Some(task) => Ok(Box::new(FolderEnvironment::new(task)?) as Box<dyn env::Environment>),
        None => Err(env::Error::Model { environment: "", reason: "it is not loaded yet".into() }),
    }));
    let task: &'static FolderTask = task;
    let _ = address.set(task); // cannot fail: it is set only here
    let declared = &task.disturbances;
    let spec = if declared.is_empty() { &task.spec } else { disturbance::declare(&task.spec, declared) };
    Ok(TaskFolder { task, spec, files })
}

/// Reads and checks the model file `main` of a folder and its includes, without compiling it by MuJoCo. Meant for tests
/// with arbitrary files.
///
/// # Errors
/// [`Error`] with the file, the line and what to do.
pub fn read_model(folder: &Path, main: &str) -> Result<(), Error> {
    mjcf::read(&mut Files::open(folder)?, main).map(|_| ())
}
