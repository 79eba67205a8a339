//! The ledger of a server: the parameter regions that every token drew from, line by line, each chained to all before it.
//!
//! A line is a digest, a space, and an [`LedgerEntry`] as JSON. The digest is SHA-256, in hexadecimal, of the digest of the line
//! before (64 zeros before the first), a space, and the JSON. So a line cannot be changed, left out or added without changing
//! all digests behind it. A single digest proves everything up to it.

use std::io::{self, BufRead, BufReader, Read as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize, Serializer};
use sha2::{Digest, Sha256};

use crate::region::Region;

/// Maximal length of a line with its end.
pub const MAX_LINE_BYTES: u64 = 64 << 20;
/// Number of digits of a digest.
const DIGITS: usize = 64;

/// A line without its digest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LedgerEntry {
    /// Counts the ledger's lines from 0.
    pub n: u64,
    /// The time of writing, ms since 1970.
    pub unix_ms: u64,
    /// The event.
    #[serde(flatten)]
    pub event: LedgerEvent,
}

/// An event of the ledger.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum LedgerEvent {
    /// A server began.
    Began {
        /// The server's version.
        version: String,
        /// The server's commit.
        commit: String,
        /// Bytes of a line that the server before did not finish, and that were removed: its request had no answer yet.
        unfinished: u64,
    },
    /// A session draws from other regions from now on.
    Draws(DrawRecord),
    /// A session was not allowed to draw from a region.
    Refused {
        /// The session.
        #[serde(flatten)]
        who: LedgerSession,
        /// The region.
        region: Region,
        /// The reason.
        reason: String,
    },
    /// The server ended, after all sessions had ended.
    Ended,
}

/// The session of an entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LedgerSession {
    /// Number of the session, unique until the server starts again.
    pub session: u64,
    /// The name of the session's token; none if it needed none.
    pub token: Option<String>,
    /// The environment.
    pub environment: String,
    /// The environment's revision.
    pub revision: u32,
}

/// A change of the regions that environments of a session draw from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrawRecord {
    /// The session.
    #[serde(flatten)]
    pub who: LedgerSession,
    /// The new regions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<Region>,
    /// Environments that begin to draw from them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub begins: Vec<DrawStart>,
    /// Environments that no longer draw from the regions before.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ends: Vec<DrawEnd>,
}

/// Environments that begin to draw. The seed, an environment's index and an episode's number fix the episode.
///
/// Written as an array of its fields in their order. Older servers wrote an object, which is read, too.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct DrawStart {
    /// The seed.
    pub seed: u64,
    /// The index of the first environment.
    pub index: u32,
    /// The number of environments, with successive indices.
    pub count: u32,
    /// The place of their region in [`DrawRecord::regions`].
    pub region: u32,
    /// The first episode that is drawn from it.
    pub episode: u64,
}

impl Serialize for DrawStart {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (self.seed, self.index, self.count, self.region, self.episode).serialize(serializer)
    }
}

/// Environments that no longer draw from their region. Written as an array, as [`DrawStart`] is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub struct DrawEnd {
    /// The seed.
    pub seed: u64,
    /// The index of the first environment.
    pub index: u32,
    /// The number of environments, with successive indices.
    pub count: u32,
    /// The last episode that was begun; none if the request was refused or failed, and nothing was drawn.
    pub episode: Option<u64>,
}

impl Serialize for DrawEnd {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        (self.seed, self.index, self.count, self.episode).serialize(serializer)
    }
}

/// The chain of the lines that were written or read so far.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chain {
    /// Number of lines.
    lines: u64,
    /// Digest of the last line.
    head: String,
}

impl Default for Chain {
    fn default() -> Self {
        Self { lines: 0, head: "0".repeat(DIGITS) }
    }
}

/// Why a ledger cannot be read, or is not valid.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be read.
    #[error("cannot read {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: io::Error,
    },
    /// A line was changed.
    #[error("line {line} of {path} {what}: the file was changed after it was written, or is no ledger")]
    Broken {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The reason.
        what: &'static str,
    },
}

impl Chain {
    /// The number of lines.
    pub fn lines(&self) -> u64 {
        self.lines
    }

    /// The digest of the last line, 64 hexadecimal digits.
    pub fn head(&self) -> &str {
        &self.head
    }

    /// Appends an event. Returns its line with the end of line.
    ///
    /// # Errors
    /// An event that cannot be written as JSON.
    pub fn add(&mut self, event: &LedgerEvent, unix_ms: u64) -> serde_json::Result<String> {
        let entry = LedgerEntry { n: self.lines, unix_ms, event: event.clone() };
        let json = serde_json::to_string(&entry)?;
        self.head = self.digest(&json);
        self.lines += 1;
        Ok(format!("{} {json}\n", self.head))
    }

    /// Appends a line that was read, without its end. The error is the reason why it is not valid.
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
    /// The chain after the last whole line.
    pub chain: Chain,
    /// Bytes of whole lines.
    pub bytes: u64,
    /// Bytes behind the whole lines: a line that a server did not finish, or that is being written.
    pub unfinished: u64,
}

/// Reads a ledger, checks its chain, and calls `each` with every entry and its digest.
///
/// # Errors
/// [`Error`].
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
        let of = |text: String| {
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
            match of(text) {
                Err(Error::Broken { line: got, .. }) => assert_eq!(got, line),
                other => panic!("{other:?}"),
            }
        }
        let cut = of(whole[..whole.len() - 1].to_owned()).unwrap();
        assert_eq!((cut.chain.lines(), cut.unfinished), (2, lines[2].len() as u64 - 1), "its end was never written");
    }
}
