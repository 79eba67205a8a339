//! Writes the ledger: what every token drew, before it draws it. See [`perturb_protocol::ledger`].

use super::status::Refusal;
use perturb_protocol::ledger::{Chain, Event, read};
use std::{
    fs::{File, OpenOptions},
    io::{self, Write},
    os::unix::fs::OpenOptionsExt,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, Sender, channel},
    },
    time::SystemTime,
};
use tokio::sync::oneshot;

/// A line to be written, and who waits until it is.
type Line = (Event, Option<oneshot::Sender<Result<(), String>>>);

/// A server's ledger. A thread of its own writes it.
#[derive(Clone)]
pub struct Ledger {
    lines: Sender<Line>,
    sessions: Arc<AtomicU64>,
}

impl Ledger {
    /// Goes on with a ledger, whose chain is checked, or begins one.
    ///
    /// # Errors
    /// If the file is no whole ledger, another server writes it, or it cannot be written.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).append(true).create(true).mode(0o600).open(path)?;
        if !file.metadata()?.is_file() {
            return Err(io::Error::other("that is no file, and a ledger is read again when the server begins"));
        }
        file.try_lock().map_err(|_| io::Error::other("another server writes it"))?;
        let there = read(path, |_, _| {}).map_err(io::Error::other)?;
        let mut book = Book { file, path: path.to_owned(), bytes: there.bytes, chain: there.chain, kept: Vec::new() };
        book.file.set_len(there.bytes)?;
        let (version, commit) = (env!("CARGO_PKG_VERSION").into(), env!("PERTURB_COMMIT").into());
        let began = Event::Began { version, commit, unfinished: there.unfinished };
        book.write([&began]).map_err(io::Error::other)?;
        let (lines, received) = channel();
        std::thread::Builder::new().name("ledger".into()).spawn(move || book.keep(&received))?;
        Ok(Self { lines, sessions: Arc::default() })
    }

    /// A number for a session.
    pub fn session(&self) -> u64 {
        self.sessions.fetch_add(1, Ordering::Relaxed)
    }

    /// Writes a line, and waits until it is on the disk.
    ///
    /// # Errors
    /// [`Refusal::NoLedger`].
    pub async fn write(&self, event: Event) -> Result<(), Refusal> {
        let (done, written) = oneshot::channel();
        let _ = self.lines.send((event, Some(done))); // nobody is there only if the thread is gone, and then nobody answers
        let reason = match written.await {
            Ok(Ok(())) => return Ok(()),
            Ok(Err(reason)) => reason,
            Err(_) => "its thread is gone".into(),
        };
        Err(Refusal::NoLedger { reason })
    }

    /// Has a line written, sooner or later.
    pub fn note(&self, event: Event) {
        let _ = self.lines.send((event, None));
    }

    /// Writes that the server ends, after all lines before.
    pub async fn close(&self) {
        if let Err(error) = self.write(Event::Ended).await {
            tracing::error!("{error}");
        }
    }
}

/// The file, as far as it is whole.
struct Book {
    file: File,
    path: PathBuf,
    bytes: u64,
    chain: Chain,
    /// What nobody waits for and could not be written yet.
    kept: Vec<Line>,
}

impl Book {
    /// Writes what comes, whatever has come meanwhile at once.
    fn keep(mut self, received: &Receiver<Line>) {
        while let Ok(first) = received.recv() {
            let mut lines = std::mem::take(&mut self.kept);
            lines.push(first);
            lines.extend(received.try_iter());
            let written = self.write(lines.iter().map(|(event, _)| event));
            if let Err(reason) = &written {
                tracing::error!("{} cannot be written: {reason}", self.path.display());
            }
            for (event, done) in lines {
                match done {
                    Some(done) => drop(done.send(written.clone())),
                    None if written.is_err() => self.kept.push((event, None)),
                    None => {}
                }
            }
        }
        tracing::info!(lines = self.chain.lines(), head = self.chain.head(), "the ledger {}", self.path.display());
    }

    /// Writes lines and waits for the disk; all, or none.
    fn write<'a>(&mut self, events: impl IntoIterator<Item = &'a Event>) -> Result<(), String> {
        #[expect(clippy::disallowed_methods, reason = "lines have their time; what is drawn does not depend on it")]
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let unix_ms = u64::try_from(now.as_millis()).unwrap_or(u64::MAX);
        let mut chain = self.chain.clone();
        let lines: Result<String, _> = events.into_iter().map(|event| chain.add(event, unix_ms)).collect();
        let lines = lines.map_err(|error| error.to_string())?;
        if let Err(error) = self.file.write_all(lines.as_bytes()).and_then(|()| self.file.sync_data()) {
            // What is there of them is no line.
            let _ = self.file.set_len(self.bytes);
            return Err(error.to_string());
        }
        self.bytes += lines.len() as u64;
        self.chain = chain;
        Ok(())
    }
}
