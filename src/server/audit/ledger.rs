//! Writes the ledger, a file that records every draw of parameters before it happens. [`perturb_protocol::ledger`]
//! defines its format.

use super::Error;
use crate::server::error::InvalidValue;
use perturb_protocol::ledger::{Chain, LedgerEvent, MAX_LINE_BYTES, read};
use perturb_system::{
    explain_no_thread,
    support::{Operation, is_acquired, unless_unsupported},
};
use std::{
    fs::{File, OpenOptions},
    io::{self, Write},
    os::unix::fs::{MetadataExt, OpenOptionsExt},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    time::{Duration, SystemTime},
};
use tokio::sync::oneshot;

/// The interval at which the ledger file is checked while nothing is written.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// An event to be written. If a caller waits for the result, also the channel for reporting success or the reason of a
/// failure.
type WriteRequest = (LedgerEvent, Option<oneshot::Sender<Result<(), String>>>);

/// A handle to the server's ledger, which is written by a thread of its own.
#[derive(Clone)]
pub struct Ledger {
    lines: Sender<WriteRequest>,
    sessions: Arc<AtomicU64>,
    status: Arc<LedgerStatus>,
}

/// The state of the ledger file, for metrics.
#[derive(Default)]
pub struct LedgerStatus {
    is_lost: AtomicBool,
    bytes: AtomicU64,
}

impl LedgerStatus {
    /// Whether the file still contains everything that this server wrote. If not, requests that draw are refused.
    pub fn is_intact(&self) -> bool {
        !self.is_lost.load(Ordering::Relaxed)
    }

    /// The total length of the file's complete lines, bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }
}

impl Ledger {
    /// Opens the ledger at `path`. Checks the hash chain of an existing ledger and continues it, or creates a new
    /// ledger.
    ///
    /// # Errors
    /// If the file is not a valid ledger, another server is writing it, it cannot be read or written, or the writer
    /// thread cannot be started.
    pub fn open(path: &Path) -> io::Result<Self> {
        if path.metadata().is_ok_and(|metadata| !metadata.is_file()) {
            return Err(io::Error::other(
                "this is not a regular file, but the server must read its ledger at each start",
            ));
        }
        let file = OpenOptions::new().read(true).append(true).create(true).mode(0o600).open(path)?;
        if !file.metadata()?.is_file() {
            return Err(io::Error::other(
                "this is not a regular file, but the server must read its ledger at each start",
            ));
        }
        if is_acquired(file.try_lock(), path)? == Some(false) {
            return Err(io::Error::other("another server is writing to it"));
        }
        let existing = read(path, |_, _| {}).map_err(io::Error::other)?;
        if existing.chain.lines() == 0 && existing.unfinished > 0 {
            return Err(io::Error::other("that is not a ledger, and not empty: give another name"));
        }
        let mut writer = LedgerWriter {
            file,
            path: path.to_owned(),
            bytes: existing.bytes,
            chain: existing.chain,
            pending: Vec::new(),
            is_torn: true,
            status: Arc::default(),
        };
        let (version, commit) = (env!("CARGO_PKG_VERSION").into(), env!("PERTURB_COMMIT").into());
        let start = LedgerEvent::Began { version, commit, unfinished: existing.unfinished };
        writer.write([&start]).map_err(io::Error::other)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        // Puts the directory entry of a new file on the disk.
        unless_unsupported(Operation::Sync, File::open(folder)?.sync_all(), folder)?;
        let (lines, received) = channel();
        let status = Arc::clone(&writer.status);
        std::thread::Builder::new()
            .name("ledger".into())
            .spawn(move || writer.run(&received))
            .map_err(|error| explain_no_thread(&error))?;
        Ok(Self { lines, sessions: Arc::default(), status })
    }

    /// Returns the state of the ledger file.
    pub fn status(&self) -> &LedgerStatus {
        &self.status
    }

    /// Returns a new number for a session, unique until the server ends.
    pub fn session(&self) -> u64 {
        self.sessions.fetch_add(1, Ordering::Relaxed)
    }

    /// Writes an event as a line, and waits until it is on the disk. Returns an upper bound of the [line's
    /// length](line_bytes) in bytes.
    ///
    /// # Errors
    /// [`Error::NoLedger`] if the file cannot be written, [`Error::Value`] if the line would be too long.
    pub async fn write(&self, event: LedgerEvent) -> Result<usize, Error> {
        // The length of requests is limited, but numbers take more bytes as text, so the length of the line is checked,
        // too.
        let size = line_bytes(&event);
        if size as u64 > MAX_LINE_BYTES / 2 {
            let got = format!("{size} bytes");
            return Err(InvalidValue::new(
                "the length of the request's line in this server's ledger",
                got,
                format!("at most {}: request fewer draws at a time", MAX_LINE_BYTES / 2),
            )
            .into());
        }
        let (done, written) = oneshot::channel();
        let _ = self.lines.send((event, Some(done))); // fails only if the thread has ended; then `written` fails, too
        let reason = match written.await {
            Ok(Ok(())) => return Ok(size),
            Ok(Err(reason)) => reason,
            Err(_) => "the ledger's thread has ended".into(),
        };
        Err(Error::NoLedger { reason })
    }

    /// Queues an event without waiting. If the event cannot be written, the writer thread tries again with the next
    /// event.
    pub fn write_later(&self, event: LedgerEvent) {
        let _ = self.lines.send((event, None));
    }

    /// Writes all queued events, then the event that the server has ended.
    pub async fn close(&self) {
        if let Err(error) = self.write(LedgerEvent::Ended).await {
            tracing::error!("{error}");
        }
    }
}

/// Returns an upper bound of the length of an event's line in the ledger, bytes.
pub fn line_bytes(event: &LedgerEvent) -> usize {
    /// An upper bound of the length of the line's digest, number, time and line end.
    const FRAME_BYTES: usize = 128;
    // An event that cannot be converted to JSON counts as 0 bytes here. The writer thread reports the error.
    serde_json::to_vec(event).map_or(0, |json| json.len()) + FRAME_BYTES
}

/// The state of the writer thread. `bytes` and `chain` describe the complete lines of the file.
struct LedgerWriter {
    file: File,
    path: PathBuf,
    bytes: u64,
    chain: Chain,
    /// Whether a failed write may have left an incomplete line after the first `bytes`.
    is_torn: bool,
    /// Events from [`Ledger::write_later`] that could not be written yet.
    pending: Vec<WriteRequest>,
    status: Arc<LedgerStatus>,
}

impl LedgerWriter {
    /// Writes events until all handles are dropped. Events that are queued at the same time are written to the disk
    /// together.
    fn run(mut self, received: &Receiver<WriteRequest>) {
        loop {
            let first = match received.recv_timeout(CHECK_INTERVAL) {
                Ok(first) => first,
                Err(RecvTimeoutError::Disconnected) => return,
                Err(RecvTimeoutError::Timeout) => {
                    let _ = self.check_file(); // logs the error itself
                    continue;
                }
            };
            let mut lines = std::mem::take(&mut self.pending);
            lines.push(first);
            lines.extend(received.try_iter());
            let written = self.write(lines.iter().map(|(event, _)| event));
            if let Err(reason) = &written {
                tracing::error!("{} cannot be written: {reason}", self.path.display());
            }
            if lines.iter().any(|(event, _)| matches!(event, LedgerEvent::Ended)) {
                let (lines, head) = (self.chain.lines(), self.chain.head());
                tracing::info!(lines, head, "the ledger {}", self.path.display());
            }
            for (event, done) in lines {
                match done {
                    Some(done) => drop(done.send(written.clone())),
                    None if written.is_err() => self.pending.push((event, None)),
                    None => {}
                }
            }
        }
    }

    /// Checks that the file at the path is still the file that was written. Logs when it is lost, and when it is back.
    ///
    /// # Errors
    /// If the file was moved, replaced or changed: a text that says which, and how to continue.
    fn check_file(&self) -> Result<(), String> {
        let found = self.file_is_intact();
        match (&found, self.status.is_lost.swap(found.is_err(), Ordering::Relaxed)) {
            (Err(reason), false) => {
                let (lines, head) = (self.chain.lines(), self.chain.head());
                tracing::error!(
                    lines,
                    head,
                    "the ledger {}: {reason}; until this is repaired, requests that draw parameters are refused",
                    self.path.display()
                );
            }
            (Ok(()), true) => tracing::info!("the ledger {} is intact again", self.path.display()),
            _ => {}
        }
        found
    }

    /// Checks that the open file is still the file at the path, and that the file's length is the number of bytes that
    /// were written.
    fn file_is_intact(&self) -> Result<(), String> {
        let own = self.file.metadata().map_err(|error| error.to_string())?;
        match self.path.metadata() {
            Err(error) => return Err(format!("the file is gone ({error}); move it back, or restart the server")),
            Ok(at_path) if (at_path.dev(), at_path.ino()) != (own.dev(), own.ino()) => {
                return Err("another file has taken its place; move it back, or restart the server".into());
            }
            Ok(_) => {}
        }
        if own.len() < self.bytes || (own.len() > self.bytes && !self.is_torn) {
            let (got, expected) = (own.len(), self.bytes);
            return Err(format!(
                "the file has {got} bytes, but the server wrote {expected}; undo the change that another program \
                 made to the file, or restart the server"
            ));
        }
        Ok(())
    }

    /// Writes all events as lines, and waits until they are on the disk. On an error, writes none.
    fn write<'a>(&mut self, events: impl IntoIterator<Item = &'a LedgerEvent>) -> Result<(), String> {
        #[expect(clippy::disallowed_methods, reason = "each line states its time; draws do not depend on it")]
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let unix_ms = u64::try_from(now.as_millis()).unwrap_or(u64::MAX);
        self.check_file()?;
        let mut chain = self.chain.clone();
        let lines: Result<String, _> = events.into_iter().map(|event| chain.add(event, unix_ms)).collect();
        let lines = lines.map_err(|error| error.to_string())?;
        if self.is_torn {
            self.file.set_len(self.bytes).map_err(|error| error.to_string())?;
            self.is_torn = false;
        }
        let written = self.file.write_all(lines.as_bytes());
        let synced = written.and_then(|()| unless_unsupported(Operation::Sync, self.file.sync_data(), &self.path));
        if let Err(error) = synced {
            // Cuts off everything that this call wrote: a failed write may leave an incomplete line.
            self.is_torn = self.file.set_len(self.bytes).is_err();
            return Err(error.to_string());
        }
        self.bytes += lines.len() as u64;
        self.status.bytes.store(self.bytes, Ordering::Relaxed);
        self.chain = chain;
        Ok(())
    }
}
