//! Following a log of lines that grows: what is new of it, and nothing twice.

use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use perturb_study::files::{Stamp, open_plain};

/// At most so much is read at a time, bytes; the rest at the next look. No line is longer.
pub(crate) const MOST: u64 = 64 << 20;
/// So much before the end is compared with what it was: a log that was cut back and has grown again is another one.
const REMEMBERED: usize = 64;

/// Follows a file.
#[derive(Debug)]
pub(crate) struct Tail {
    path: PathBuf,
    stamp: Option<Stamp>,
    /// Where the next line begins.
    offset: u64,
    /// What stands before it.
    before: Vec<u8>,
    /// The next line has no end: there is nothing more to read of this file, told by its number.
    endless: Option<u64>,
}

/// What came of a look.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Look {
    /// Nothing is new.
    Same,
    /// More lines.
    More(Vec<u8>),
    /// The file is another one, or was cut back; its lines from the beginning. None if it is gone.
    Anew(Vec<u8>),
    /// The next line is longer than anything that is read.
    Endless,
}

impl Tail {
    pub(crate) fn of(path: &Path) -> Self {
        Self { path: path.to_owned(), stamp: None, offset: 0, before: Vec::new(), endless: None }
    }

    /// Reads whole lines that were not there.
    pub(crate) fn look(&mut self) -> std::io::Result<Look> {
        let (mut file, metadata) = match open_plain(&self.path) {
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let known = self.stamp.take().is_some();
                (self.offset, self.before, self.endless) = (0, Vec::new(), None);
                return Ok(if known { Look::Anew(Vec::new()) } else { Look::Same });
            }
            opened => opened?,
        };
        let now = Stamp::of_metadata(&metadata);
        let stamp = Some(now);
        let still_endless = self.endless == Some(now.inode()) && now.length() >= self.offset + MOST;
        if stamp == self.stamp || still_endless {
            return Ok(Look::Same);
        }
        let begun = self.stamp.is_some();
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(self.offset - self.before.len() as u64))?;
        file.by_ref().take(MOST).read_to_end(&mut bytes)?;
        let anew = !bytes.starts_with(&self.before);
        if anew {
            (self.offset, self.before) = (0, Vec::new());
            bytes.clear();
            file.seek(SeekFrom::Start(0))?;
            file.by_ref().take(MOST).read_to_end(&mut bytes)?;
        }
        let full = bytes.len() as u64 == MOST; // there may be more: look again although the file is the same
        let endless = full && !bytes[self.before.len()..].contains(&b'\n');
        self.endless = endless.then_some(now.inode());
        let lines = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |last| last + 1).max(self.before.len());
        bytes.truncate(lines);
        let new = bytes.split_off(self.before.len());
        self.offset += new.len() as u64;
        self.before.extend(&new[new.len().saturating_sub(REMEMBERED)..]);
        self.before.drain(..self.before.len().saturating_sub(REMEMBERED));
        self.stamp = if full { Some(Stamp::default()) } else { stamp };
        Ok(match () {
            () if endless => Look::Endless,
            () if anew && begun => Look::Anew(new),
            () if new.is_empty() => Look::Same,
            () => Look::More(new),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Write;

    use super::*;

    #[test]
    fn lines_are_read_once_and_whole() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log");
        let mut tail = Tail::of(&path);
        assert_eq!(tail.look().unwrap(), Look::Same, "it is not there yet");
        let add =
            |text: &str| File::options().create(true).append(true).open(&path).unwrap().write_all(text.as_bytes());
        add("one\ntw").unwrap();
        assert_eq!(tail.look().unwrap(), Look::More(b"one\n".into()));
        assert_eq!(tail.look().unwrap(), Look::Same);
        add("o").unwrap();
        assert_eq!(tail.look().unwrap(), Look::Same, "still half a line");
        add("\nthree\n").unwrap();
        assert_eq!(tail.look().unwrap(), Look::More(b"two\nthree\n".into()));
    }

    #[test]
    fn a_log_that_was_cut_back_is_read_anew_also_if_it_has_grown_again() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log");
        let mut tail = Tail::of(&path);
        std::fs::write(&path, "head\none\ntwo\n").unwrap();
        tail.look().unwrap();
        for text in ["head\none\nother\nmore\n", "head\n", "x\n"] {
            std::fs::write(&path, text).unwrap();
            assert_eq!(tail.look().unwrap(), Look::Anew(text.into()));
        }
        std::fs::remove_file(&path).unwrap();
        assert_eq!(tail.look().unwrap(), Look::Anew(Vec::new()));
        assert_eq!(tail.look().unwrap(), Look::Same);
    }

    #[test]
    fn a_line_without_an_end_is_told_once_and_read_once() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("log");
        std::fs::write(&path, "head\n").unwrap();
        let mut tail = Tail::of(&path);
        tail.look().unwrap();
        let file = File::options().write(true).open(&path).unwrap();
        file.set_len(MOST + 10).unwrap();
        assert_eq!(tail.look().unwrap(), Look::Endless);
        file.set_len(MOST + 20).unwrap();
        assert_eq!((tail.look().unwrap(), tail.look().unwrap()), (Look::Same, Look::Same), "however it grows");
        std::fs::write(&path, "head\none\n").unwrap();
        assert_eq!(tail.look().unwrap(), Look::More(b"one\n".into()), "it was cut back");
    }

    #[test]
    fn what_cannot_be_read_is_an_error() {
        let directory = tempfile::tempdir().unwrap();
        assert!(Tail::of(directory.path()).look().is_err(), "a folder");
        let pipe = directory.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        assert!(Tail::of(&pipe).look().is_err(), "it is not waited for");
    }
}
