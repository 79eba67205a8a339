//! Files that are read again when they change.

use std::{
    io,
    path::{Path, PathBuf},
    sync::mpsc::{RecvTimeoutError, Sender, channel},
    time::Duration,
};

/// The interval at which the files are read.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// Watches files, on a thread of its own, until it is dropped.
pub struct FileWatcher(#[expect(dead_code, reason = "its end is the thread's")] Sender<()>);

/// The contents of the files, in their order, or why they cannot be read.
pub type Contents = Result<Vec<Vec<u8>>, String>;

/// Reads files.
///
/// # Errors
/// A sentence that names the file.
pub fn read(paths: &[PathBuf]) -> Contents {
    let read = |path: &Path| std::fs::read(path).map_err(|error| format!("cannot read {}: {error}", path.display()));
    paths.iter().map(|path| read(path)).collect()
}

impl FileWatcher {
    /// Calls `reload` with the contents of the files when they have changed and stay so for a moment, since a writer
    /// may not be done. `before` is what was read at first. An error is logged, and the next change is waited for.
    ///
    /// # Errors
    /// If there is no thread.
    pub fn start(
        what: &'static str,
        paths: Vec<PathBuf>,
        before: Vec<Vec<u8>>,
        mut reload: impl FnMut(&[Vec<u8>]) -> Result<(), String> + Send + 'static,
    ) -> io::Result<Self> {
        let (end, ended) = channel::<()>();
        let look = move || {
            let mut taken: Contents = Ok(before);
            let mut last = taken.clone();
            while ended.recv_timeout(POLL_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                let now = read(&paths);
                if now != taken && now == last {
                    match now.as_ref().map_err(Clone::clone).and_then(|contents| reload(contents)) {
                        Ok(()) => tracing::info!("read {what} again"),
                        Err(reason) => tracing::error!("{what} changed, and those of before stay in force: {reason}"),
                    }
                    taken.clone_from(&now);
                }
                last = now;
            }
        };
        std::thread::Builder::new().name("files".into()).spawn(look)?;
        Ok(Self(end))
    }
}
