//! Watches the token and TLS files, and reloads them when they change.

use perturb_system::{explain_no_thread, read_plain};
use std::{
    io,
    path::{Path, PathBuf},
    sync::mpsc::{RecvTimeoutError, Sender, channel},
    time::Duration,
};

/// The interval at which the watched files are read.
const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// The maximum length of a watched file, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// The watcher of some files. Its thread ends when the watcher and all its [reloaders](Reloader) have been dropped.
pub struct FileWatcher(Sender<()>);

/// A handle that makes file watchers reload their files immediately.
#[derive(Clone, Default)]
pub struct Reloader(Vec<Sender<()>>);

impl Reloader {
    /// Makes a reloader for these watchers.
    pub fn new(watchers: &[FileWatcher]) -> Self {
        Self(watchers.iter().map(|FileWatcher(reload_sender)| reload_sender.clone()).collect())
    }

    /// Makes the watchers reload their files immediately, even if they have not changed. Returns `false` if there is no
    /// watcher.
    pub fn reload(&self) -> bool {
        for reload_sender in &self.0 {
            let _ = reload_sender.send(()); // fails if the watcher's thread has ended
        }
        !self.0.is_empty()
    }
}

/// The contents of the files, in the order of their paths, or the reason why they cannot be read.
pub type Contents = Result<Vec<Vec<u8>>, String>;

/// Reads files. Refuses anything but regular files, so it never blocks, e.g. on a pipe.
///
/// # Errors
/// A sentence that names the file which cannot be read.
pub fn read(paths: &[PathBuf]) -> Contents {
    let read = |path: &Path| {
        read_plain(path, MAX_FILE_BYTES).map_err(|error| format!("cannot read {}: {error}", path.display()))
    };
    paths.iter().map(|path| read(path)).collect()
}

impl FileWatcher {
    /// Starts a thread that calls `reload` with the contents of the files after each change. `before` has the contents
    /// that are already loaded. New contents count only when two successive readings are equal, because another program
    /// may still be writing. A [`Reloader`] skips this check. Errors are logged, and watching continues. `what` names
    /// the files in the log.
    ///
    /// # Errors
    /// If the operating system cannot start a thread.
    pub fn start(
        what: &'static str,
        paths: Vec<PathBuf>,
        before: Vec<Vec<u8>>,
        mut reload: impl FnMut(&[Vec<u8>]) -> Result<(), String> + Send + 'static,
    ) -> io::Result<Self> {
        let (reload_sender, reload_requests) = channel::<()>();
        let watch = move || {
            let mut loaded: Contents = Ok(before);
            let mut last = loaded.clone();
            loop {
                let is_requested = match reload_requests.recv_timeout(POLL_INTERVAL) {
                    Ok(()) => true,
                    Err(RecvTimeoutError::Timeout) => false,
                    Err(RecvTimeoutError::Disconnected) => return,
                };
                let now = read(&paths);
                if is_requested || (now != loaded && now == last) {
                    match now.as_ref().map_err(Clone::clone).and_then(|contents| reload(contents)) {
                        Ok(()) => tracing::info!("read {what} again"),
                        Err(reason) => {
                            tracing::error!("{what} cannot be reloaded; the previous contents stay in force: {reason}")
                        }
                    }
                    loaded.clone_from(&now);
                }
                last = now;
            }
        };
        std::thread::Builder::new().name("files".into()).spawn(watch).map_err(|error| explain_no_thread(&error))?;
        Ok(Self(reload_sender))
    }
}
