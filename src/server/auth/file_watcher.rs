//! Files that are read again when they change.

use perturb_system::{explain_no_thread, read_plain};
use std::{
    io,
    path::{Path, PathBuf},
    sync::mpsc::{RecvTimeoutError, Sender, channel},
    time::Duration,
};

/// The interval at which the files are read.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// The maximum length of a file of tokens or certificates.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Watches files, on a thread of its own, until it and its [reloaders](Reloader) are dropped.
pub struct FileWatcher(Sender<()>);

/// Makes watchers read their files again at once.
#[derive(Clone, Default)]
pub struct Reloader(Vec<Sender<()>>);

impl Reloader {
    /// Makes a reloader of the files of these watchers.
    pub fn new(watchers: &[FileWatcher]) -> Self {
        Self(watchers.iter().map(|FileWatcher(look)| look.clone()).collect())
    }

    /// Makes the watchers read their files again at once, even if they have not changed. Returns whether there is a
    /// watcher.
    pub fn reload(&self) -> bool {
        for look in &self.0 {
            let _ = look.send(()); // a watcher that is gone needs no files
        }
        !self.0.is_empty()
    }
}

/// The contents of the files, in their order, or why they cannot be read.
pub type Contents = Result<Vec<Vec<u8>>, String>;

/// Reads plain files, without waiting for anything: a pipe is refused.
///
/// # Errors
/// A sentence that names the file.
pub fn read(paths: &[PathBuf]) -> Contents {
    let read = |path: &Path| {
        read_plain(path, MAX_FILE_BYTES).map_err(|error| format!("cannot read {}: {error}", path.display()))
    };
    paths.iter().map(|path| read(path)).collect()
}

impl FileWatcher {
    /// Calls `reload` with the contents of the files after a change. It waits until two readings agree, since a writer
    /// may not be done, but not if a [`Reloader`] asks. `before` is the contents at the start. An error is logged, and
    /// the files are watched further.
    ///
    /// # Errors
    /// If there is no thread.
    pub fn start(
        what: &'static str,
        paths: Vec<PathBuf>,
        before: Vec<Vec<u8>>,
        mut reload: impl FnMut(&[Vec<u8>]) -> Result<(), String> + Send + 'static,
    ) -> io::Result<Self> {
        let (look, asked) = channel::<()>();
        let watch = move || {
            let mut taken: Contents = Ok(before);
            let mut last = taken.clone();
            loop {
                let is_asked = match asked.recv_timeout(POLL_INTERVAL) {
                    Ok(()) => true,
                    Err(RecvTimeoutError::Timeout) => false,
                    Err(RecvTimeoutError::Disconnected) => return,
                };
                let now = read(&paths);
                if is_asked || (now != taken && now == last) {
                    match now.as_ref().map_err(Clone::clone).and_then(|contents| reload(contents)) {
                        Ok(()) => tracing::info!("read {what} again"),
                        Err(reason) => tracing::error!("{what} changed, and those of before stay in force: {reason}"),
                    }
                    taken.clone_from(&now);
                }
                last = now;
            }
        };
        std::thread::Builder::new().name("files".into()).spawn(watch).map_err(|error| explain_no_thread(&error))?;
        Ok(Self(look))
    }
}
