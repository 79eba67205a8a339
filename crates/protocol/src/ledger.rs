//! The ledger of a server: a tamper-evident log of the regions of the parameter space from which the server's sessions
//! drew.
//!
//! Each line is a digest, a space, and a [`LedgerEntry`] as JSON. The digest is the SHA-256, in hexadecimal, of the
//! previous line's digest (64 zeros for the first line), a space, and the JSON. So changing, removing or inserting a
//! line changes all later digests. The digest of one line is enough to verify all lines up to that line.

use std::io::{self, BufRead, BufReader, Read as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize, Serializer};
use sha2::{Digest, Sha256};

use crate::region::Region;

/// Maximal length of a line, in bytes, including its line feed.
pub const MAX_LINE_BYTES: u64 = 64 << 20;
/// Number of hexadecimal digits in a digest.
const DIGITS: usize = 64;

/// An entry of the ledger: the content of a line, without its digest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LedgerEntry {
    /// The number of the line, from 0.
    pub n: u64,
    /// The time of writing, in ms since the Unix epoch.
    pub unix_ms: u64,
    /// The event.
    #[serde(flatten)]
    pub event: LedgerEvent,
}

/// An event of the ledger.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum LedgerEvent {
    /// A server started.
    Began {
        /// The server's version.
        version: String,
        /// The server's commit.
        commit: String,
        /// Size of the incomplete last line that the server found and removed, in bytes. The previous server stopped
        /// while writing it, before it answered the request.
        unfinished: u64,
    },
    /// A session changed the regions from which its environments draw.
    Draws(DrawRecord),
    /// A session requested a region from which it may not draw.
    Refused {
        /// The session that made the request.
        #[serde(flatten)]
        who: LedgerSession,
        /// The requested region.
        region: Region,
        /// The reason of the refusal.
        reason: String,
    },
    /// The server ended, after all sessions had ended.
    Ended,
}

/// The session that an entry is about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LedgerSession {
    /// The number of the session. Numbers start again when the server restarts.
    pub session: u64,
    /// The name of the session's token; `None` if the server requires no tokens.
    pub token: Option<String>,
    /// The environment's name.
    pub environment: String,
    /// The environment's revision.
    pub revision: u32,
}

/// A change of the regions from which the environments of a session draw their parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrawRecord {
    /// The session that owns the environments.
    #[serde(flatten)]
    pub who: LedgerSession,
    /// The regions from which the environments in `begins` draw.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<Region>,
    /// The environments that begin to draw from these regions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub begins: Vec<DrawStart>,
    /// The environments that stop drawing from their previous regions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ends: Vec<DrawEnd>,
}

/// Environments that begin to draw from a region. The random numbers of an episode follow from the seed, the
/// environment's index and a number: the trial's number for the parameters, the episode's number for everything else.
///
/// It is serialised as an array of its fields, in order. Older servers wrote it as an object, which can also be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct DrawStart {
    /// The seed of the environments.
    pub seed: u64,
    /// The index of the first environment.
    pub index: u32,
    /// The number of environments; their indices are consecutive.
    pub count: u32,
    /// The index of their region in [`DrawRecord::regions`].
    pub region: u32,
    /// The number of the first episode whose parameters are drawn from the region.
    pub episode: u64,
}

impl Serialize for DrawStart {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (self.seed, self.index, self.count, self.region, self.episode).serialize(serializer)
    }
}

/// Environments that stop drawing from their region. It is serialised as an array of its fields, like [`DrawStart`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct DrawEnd {
    /// The seed of the environments.
    pub seed: u64,
    /// The index of the first environment.
    pub index: u32,
    /// The number of environments; their indices are consecutive.
    pub count: u32,
    /// The number of the last episode that began. `None` if the request was refused or failed, so that nothing was
    /// drawn.
    pub episode: Option<u64>,
}

impl Serialize for DrawEnd {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (self.seed, self.index, self.count, self.episode).serialize(serializer)
    }
}

/// The end of a ledger's chain of digests, after the lines written or read so far.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chain {
    /// Number of lines so far.
    lines: u64,
    /// Digest of the last line.
    head: String,
}

impl Default for Chain {
    fn default() -> Self {
        Self { lines: 0, head: "0".repeat(DIGITS) }
    }
}

/// The reason why a ledger cannot be read or is not valid.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Io {
        /// The path of the ledger's file.
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// A line is not valid, or does not match the lines before it.
    #[error("line {line} of {path} {what}: the file was changed after it was written, or is not a ledger")]
    Broken {
        /// The path of the ledger's file.
        path: PathBuf,
        /// The number of the line, from 1.
        line: u64,
        /// The fault of the line, as a part of the message, e.g. "has no digest".
        what: &'static str,
    },
}

impl Chain {
    /// The number of lines so far.
    pub fn lines(&self) -> u64 {
        self.lines
    }

    /// The digest of the last line, 64 hexadecimal digits.
    pub fn head(&self) -> &str {
        &self.head
    }

    /// Appends an event to the chain. Returns the line to write, including its line feed.
    ///
    /// # Errors
    /// The serialiser's error if the event cannot be written as JSON.
    pub fn add(&mut self, event: &LedgerEvent, unix_ms: u64) -> serde_json::Result<String> {
        let entry = LedgerEntry { n: self.lines, unix_ms, event: event.clone() };
        let json = serde_json::to_string(&entry)?;
        self.head = self.digest(&json);
        self.lines += 1;
        Ok(format!("{} {json}\n", self.head))
    }

    /// Checks a line that was read, given without its line feed, and appends it to the chain. The error is the reason
    /// why it is not valid.
    fn take(&mut self, line: &str) -> Result<LedgerEntry, &'static str> {
        let (digest, json) = line.split_once(' ').ok_or("has no digest")?;
        let own = self.digest(json);
        if own != digest {
            return Err("does not follow from the lines before it");
        }
        let entry: LedgerEntry = serde_json::from_str(json).map_err(|_| "cannot be understood")?;
        if entry.n != self.lines {
            return Err("has another number");
        }
        (self.head, self.lines) = (own, self.lines + 1);
        Ok(entry)
    }

    fn digest(&self, json: &str) -> String {
        format!("{:x}", Sha256::new().chain_update(&self.head).chain_update(" ").chain_update(json).finalize())
    }
}

/// The result of reading a ledger.
#[derive(Debug)]
pub struct Read {
    /// The chain after the last complete line.
    pub chain: Chain,
    /// Size of the complete lines, in bytes.
    pub bytes: u64,
    /// Size of the incomplete line at the end, in bytes: a server is still writing it, or stopped while writing it.
    pub unfinished: u64,
}

/// Reads a ledger and checks its chain of digests. Calls `each` with every entry and its digest.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read, [`Error::Broken`] for the first line that is not valid.
pub fn read(path: &Path, mut each: impl FnMut(LedgerEntry, &str)) -> Result<Read, Error> {
    let io = |source| Error::Io { path: path.to_owned(), source };
    let mut file = BufReader::new(perturb_system::open_plain(path).map_err(io)?.0);
    let mut read = Read { chain: Chain::default(), bytes: 0, unfinished: 0 };
    let mut line = Vec::new();
    loop {
        line.clear();
        let n = file.by_ref().take(MAX_LINE_BYTES).read_until(b'\n', &mut line).map_err(io)? as u64;
        let broken = |line: u64, what| Error::Broken { path: path.to_owned(), line: line + 1, what };
        let Some(whole) = line.strip_suffix(b"\n") else {
            if n == MAX_LINE_BYTES {
                return Err(broken(read.chain.lines(), "is longer than any that was written"));
            }
            read.unfinished = n;
            return Ok(read);
        };
        let text = std::str::from_utf8(whole).map_err(|_| "is no text");
        let entry = text.and_then(|text| read.chain.take(text));
        each(entry.map_err(|what| broken(read.chain.lines(), what))?, &read.chain.head);
        read.bytes += n;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(token: &str) -> LedgerEvent {
        let who = LedgerSession { session: 1, token: Some(token.into()), environment: "CartPole".into(), revision: 1 };
        let region = serde_json::from_str(r#"[{"length":"0.3..0.4,0.8..0.9","mass":"1"}]"#).unwrap();
        let begin = DrawStart { seed: u64::MAX, index: 3, count: 2, region: 0, episode: 0 };
        LedgerEvent::Draws(DrawRecord { who, regions: vec![region], begins: vec![begin], ends: vec![] })
    }

    fn written(file: &Path, tokens: &[&str]) -> Chain {
        let mut chain = Chain::default();
        let text: String = tokens.iter().map(|token| chain.add(&event(token), 7).unwrap()).collect();
        std::fs::write(file, text).unwrap();
        chain
    }

    #[test]
    fn ledger_survives_a_round_trip() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("ledger");
        let chain = written(&path, &["ann", "bob"]);
        let mut entries = Vec::new();
        let read = read(&path, |entry, head| entries.push((entry, head.to_owned()))).unwrap();
        assert_eq!(read.chain, chain);
        assert_eq!((entries[1].0.n, &entries[1].0.event, &*entries[1].1), (1, &event("bob"), chain.head()));
        assert_eq!((read.bytes, read.unfinished), (std::fs::metadata(&path).unwrap().len(), 0));
    }

    #[test]
    fn draws_are_arrays_and_objects_are_read_too() {
        let LedgerEvent::Draws(record) = event("ann") else { unreachable!() };
        let ends = vec![DrawEnd { seed: 7, index: 3, count: 2, episode: None }];
        let record = DrawRecord { ends, ..record };
        let text = serde_json::to_string(&LedgerEvent::Draws(record.clone())).unwrap();
        let (begin, end) = ("[18446744073709551615,3,2,0,0]", "[7,3,2,null]");
        assert!(text.contains(begin) && text.contains(end), "{text}");
        let begin_object = r#"{"seed":18446744073709551615,"index":3,"count":2,"region":0,"episode":0}"#;
        let end_object = r#"{"seed":7,"index":3,"count":2,"episode":null}"#;
        for text in [text.clone(), text.replace(begin, begin_object).replace(end, end_object)] {
            assert_eq!(serde_json::from_str::<LedgerEvent>(&text).unwrap(), LedgerEvent::Draws(record.clone()));
        }
    }

    #[test]
    fn changed_removed_and_added_lines_are_found() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("ledger");
        written(&path, &["ann", "bob", "cid"]);
        let whole = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = whole.split_inclusive('\n').collect();
        let read_changed = |text: String| {
            std::fs::write(&path, text).unwrap();
            read(&path, |_, _| {})
        };
        for (text, line) in [
            (whole.replacen("ann", "bob", 1), 1),
            (whole.replacen("[[1844", "[[2844", 1), 1),
            (format!("{}{}", lines[0], lines[2]), 2),
            (lines[1].to_owned(), 1),
            (format!("{}{}{}", lines[1], lines[0], lines[2]), 1),
            (format!("{}{}", lines[0], whole), 2),
            (format!("{whole}\n"), 4),
            ("no ledger\n".to_owned(), 1),
        ] {
            match read_changed(text) {
                Err(Error::Broken { line: got, .. }) => assert_eq!(got, line),
                other => panic!("{other:?}"),
            }
        }
        let cut = read_changed(whole[..whole.len() - 1].to_owned()).unwrap();
        assert_eq!((cut.chain.lines(), cut.unfinished), (2, lines[2].len() as u64 - 1), "its end was never written");
    }
}
