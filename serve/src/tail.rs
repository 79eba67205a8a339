//! Reads the lines that are appended to a growing file, each line once.

use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use perturb_files::{Stamp, open_plain};

/// Maximum number of bytes that one call of [`Tail::read_new`] reads. The next call continues after them. A longer line
/// is not read.
pub(crate) const MAX_READ_BYTES: u64 = 64 << 20;
/// Number of bytes before the read position that are compared with the file again. A difference shows that the file was
/// truncated and has grown again.
const CONTEXT_BYTES: usize = 64;

/// The read position in a growing file.
#[derive(Debug)]
pub(crate) struct Tail {
    path: PathBuf,
    stamp: Option<Stamp>,
    /// Position in the file at which the next line begins, in bytes.
    offset: u64,
    /// The bytes before `offset`, at most [`CONTEXT_BYTES`].
    context: Vec<u8>,
    /// Inode of the file if its next line is too long. Nothing more is read from the file unless it is truncated.
    oversized_inode: Option<u64>,
}

/// The result of reading new lines.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum TailUpdate {
    /// There are no new lines.
    Unchanged,
    /// Lines were appended; these are their bytes.
    Appended(Vec<u8>),
    /// The file was replaced, truncated or deleted. These are its lines from the beginning.
    Restarted(Vec<u8>),
    /// The next line is longer than [`MAX_READ_BYTES`].
    LineTooLong,
}

impl Tail {
    pub(crate) fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), stamp: None, offset: 0, context: Vec::new(), oversized_inode: None }
    }

    /// Reads the complete lines that were written since the last call.
    pub(crate) fn read_new(&mut self) -> std::io::Result<TailUpdate> {
        let (mut file, metadata) = match open_plain(&self.path) {
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let known = self.stamp.take().is_some();
                (self.offset, self.context, self.oversized_inode) = (0, Vec::new(), None);
                return Ok(if known { TailUpdate::Restarted(Vec::new()) } else { TailUpdate::Unchanged });
            }
            opened => opened?,
        };
        let now = Stamp::from_metadata(&metadata);
        let stamp = Some(now);
        let still_oversized = self.oversized_inode == Some(now.inode()) && now.length() >= self.offset + MAX_READ_BYTES;
        if stamp == self.stamp || still_oversized {
            return Ok(TailUpdate::Unchanged);
        }
        let was_read = self.stamp.is_some();
        let mut bytes = Vec::new();
        // Reads the context again, and the new bytes after it. If the context differs, the file has been replaced, and
        // is read from its beginning.
        file.seek(SeekFrom::Start(self.offset - self.context.len() as u64))?;
        file.by_ref().take(MAX_READ_BYTES).read_to_end(&mut bytes)?;
        let restarted = !bytes.starts_with(&self.context);
        if restarted {
            (self.offset, self.context) = (0, Vec::new());
            bytes.clear();
            file.seek(SeekFrom::Start(0))?;
            file.by_ref().take(MAX_READ_BYTES).read_to_end(&mut bytes)?;
        }
        // If the maximum was read, the next call must read on even if the file has not changed.
        let is_full = bytes.len() as u64 == MAX_READ_BYTES;
        let is_oversized = is_full && !bytes[self.context.len()..].contains(&b'\n');
        self.oversized_inode = is_oversized.then_some(now.inode());
        let lines = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last + 1).max(self.context.len());
        bytes.truncate(lines);
        let new = bytes.split_off(self.context.len());
        self.offset += new.len() as u64;
        self.context.extend(&new[new.len().saturating_sub(CONTEXT_BYTES)..]);
        self.context.drain(..self.context.len().saturating_sub(CONTEXT_BYTES));
        self.stamp = if is_full { Some(Stamp::default()) } else { stamp };
        Ok(match () {
            () if is_oversized => TailUpdate::LineTooLong,
            () if restarted && was_read => TailUpdate::Restarted(new),
            () if new.is_empty() => TailUpdate::Unchanged,
            () => TailUpdate::Appended(new),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Write;

    use super::*;

    #[test]
    fn complete_lines_are_read_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log");
        let mut tail = Tail::new(&path);
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Unchanged, "it is not there yet");
        let add =
            |text: &str| File::options().create(true).append(true).open(&path).unwrap().write_all(text.as_bytes());
        add("one\ntw").unwrap();
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Appended(b"one\n".into()));
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Unchanged);
        add("o").unwrap();
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Unchanged, "still half a line");
        add("\nthree\n").unwrap();
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Appended(b"two\nthree\n".into()));
    }

    #[test]
    fn a_truncated_log_is_read_again_although_it_has_grown() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log");
        let mut tail = Tail::new(&path);
        std::fs::write(&path, "head\none\ntwo\n").unwrap();
        tail.read_new().unwrap();
        for text in ["head\none\nother\nmore\n", "head\n", "x\n"] {
            std::fs::write(&path, text).unwrap();
            assert_eq!(tail.read_new().unwrap(), TailUpdate::Restarted(text.into()));
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Restarted(Vec::new()));
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Unchanged);
    }

    #[test]
    fn an_oversized_line_is_reported_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log");
        std::fs::write(&path, "head\n").unwrap();
        let mut tail = Tail::new(&path);
        tail.read_new().unwrap();
        let file = File::options().write(true).open(&path).unwrap();
        file.set_len(MAX_READ_BYTES + 10).unwrap();
        assert_eq!(tail.read_new().unwrap(), TailUpdate::LineTooLong);
        file.set_len(MAX_READ_BYTES + 20).unwrap();
        assert_eq!(
            (tail.read_new().unwrap(), tail.read_new().unwrap()),
            (TailUpdate::Unchanged, TailUpdate::Unchanged),
            "however it grows"
        );
        std::fs::write(&path, "head\none\n").unwrap();
        assert_eq!(tail.read_new().unwrap(), TailUpdate::Appended(b"one\n".into()), "it was truncated");
    }

    #[test]
    fn folders_and_pipes_are_errors() {
        let directory = tempfile::tempdir().unwrap();
        assert!(Tail::new(directory.path()).read_new().is_err(), "a folder");
        let pipe = directory.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        assert!(Tail::new(&pipe).read_new().is_err(), "a pipe, which is not waited for");
    }
}
