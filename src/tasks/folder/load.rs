//! Loading a folder, which stays in memory until the process ends.

use super::{
    environment::{FolderEnvironment, Task},
    error::Error,
    file,
    files::Files,
    mjcf,
};
use crate::env::{self, EnvironmentSpec, disturbance};
use std::{fmt, path::Path, sync::OnceLock};

/// A loaded folder. It lives as long as the process: environments, catalogues and sessions refer to it.
#[derive(Clone, Copy)]
pub struct Folder {
    pub(super) task: &'static Task,
    spec: &'static EnvironmentSpec,
    pub(super) files: &'static Files,
}

impl Folder {
    /// The environment; with disturbances among its parameters, if the task declares sets for one.
    pub fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    /// Whether the files on the disk are still those that were loaded.
    pub fn is_unchanged(&self) -> bool {
        self.files.look_unchanged()
    }
}

impl fmt::Debug for Folder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Folder").field("name", &self.task.spec.name).finish_non_exhaustive()
    }
}

/// Loads a folder. Its contents stay in memory until the process ends, because sessions refer to them.
///
/// A model may abort the process or take all of its memory: load folders that were never loaded before in a process of
/// their own.
///
/// # Errors
/// [`Error`] with the place and the remedy.
pub fn load(folder: &Path) -> Result<Folder, Error> {
    let mut files = Files::open(folder)?;
    let task = file::read(&mut files)?;
    if !files.are_unchanged() {
        return Err(Error::folder("the files changed while they were loaded; load the folder again"));
    }
    let files: &'static Files = Box::leak(Box::new(files));
    let task: &'static mut Task = Box::leak(Box::new(task));
    // The spec's closure needs the address of the task, and the task contains the spec.
    let address: &'static OnceLock<&'static Task> = Box::leak(Box::default());
    task.spec.make = Box::leak(Box::new(move || match address.get() {
        Some(task) => Ok(Box::new(FolderEnvironment::new(task)?) as Box<dyn env::Environment>),
        None => Err(env::Error::Model { environment: "", reason: "it is not loaded yet".into() }),
    }));
    let task: &'static Task = task;
    let _ = address.set(task); // it is set once
    let declared = &task.disturbances;
    let spec = if declared.is_empty() { &task.spec } else { disturbance::declare(&task.spec, declared) };
    Ok(Folder { task, spec, files })
}

/// Reads the model `main` of a folder and its includes, without MuJoCo. It is meant for tests with untrusted files.
///
/// # Errors
/// [`Error`] with the place and the remedy.
pub fn read_model(folder: &Path, main: &str) -> Result<(), Error> {
    mjcf::read(&mut Files::open(folder)?, main).map(|_| ())
}
