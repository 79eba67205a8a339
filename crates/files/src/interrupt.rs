//! Ctrl-C and SIGTERM as a flag that loops look at, and folders that do not outlive them.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use tokio::signal::unix::{SignalKind, signal};

/// The folders of all [`Scratch`].
static SCRATCH: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Raised when the program is asked to end.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicI32>);

impl StopFlag {
    /// A flag that SIGINT and SIGTERM raise. The first one asks, the second one ends the program at once.
    ///
    /// # Errors
    /// The operating system's.
    pub fn on_signals() -> std::io::Result<Self> {
        let flag = Self::default();
        let raised = flag.clone();
        watch(move |number| {
            if raised.0.swap(number, Ordering::SeqCst) != 0 {
                end(number);
            }
        })?;
        Ok(flag)
    }

    /// The number of the signal that was received; `None` so far.
    pub fn signal(&self) -> Option<i32> {
        Some(self.0.load(Ordering::SeqCst)).filter(|&number| number != 0)
    }

    /// Raises it, as signal `number` would.
    pub fn raise(&self, number: i32) {
        self.0.store(number, Ordering::SeqCst);
    }
}

/// Has SIGINT and SIGTERM end a program at once that has nothing to finish.
///
/// # Errors
/// The operating system's.
pub fn end_on_signals() -> std::io::Result<()> {
    watch(|number| {
        let _ = writeln!(std::io::stderr(), "stopped by signal {number}"); // the terminal may be gone
        end(number);
    })
}

/// Has `hear` told of every SIGINT and SIGTERM.
fn watch(mut hear: impl FnMut(i32) + Send + 'static) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let (mut interrupt, mut terminate) = {
        let _guard = runtime.enter();
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
    };
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        runtime.block_on(async move {
            loop {
                hear(tokio::select! {
                    Some(()) = interrupt.recv() => SignalKind::interrupt().as_raw_value(),
                    Some(()) = terminate.recv() => SignalKind::terminate().as_raw_value(),
                    else => return,
                });
            }
        });
    })?;
    Ok(())
}

/// Ends the program with the status that shells give to signal `number`, and deletes what is temporary.
fn end(number: i32) -> ! {
    for folder in scratch().iter() {
        let _ = std::fs::remove_dir_all(folder); // the program ends anyway
    }
    std::process::exit(128 + number);
}

/// A temporary folder, which lives no longer than this value, nor than a program that a signal ends.
#[derive(Debug)]
pub struct Scratch(PathBuf);

impl Scratch {
    /// A new one.
    ///
    /// # Errors
    /// The operating system's.
    pub fn new() -> std::io::Result<Self> {
        let mut known = scratch(); // so that no signal comes between
        let folder = tempfile::Builder::new().prefix("perturb-").tempdir()?.keep();
        known.push(folder.clone());
        Ok(Self(folder))
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let mut known = scratch();
        let _ = std::fs::remove_dir_all(&self.0); // what is left of it harms nobody
        known.retain(|folder| *folder != self.0);
    }
}

fn scratch() -> std::sync::MutexGuard<'static, Vec<PathBuf>> {
    SCRATCH.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scratch_folder_is_known_while_it_is_there() {
        let folder = Scratch::new().unwrap();
        let path = folder.path().to_owned();
        std::fs::write(path.join("file"), "x").unwrap();
        assert!(scratch().contains(&path));
        drop(folder);
        assert!(!path.exists() && !scratch().contains(&path));
    }
}
