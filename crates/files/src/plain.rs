//! Regular files in folders to which other users may write. Opening them never blocks, their size is limited, and
//! changes are detected.

use std::fs::Metadata;
use std::io::{Error, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use rustix::io::Errno;

use super::{Result, if_there, io};

/// Maximal size of a file that is read into memory, in bytes.
pub(super) const MAX_BYTES: u64 = 1 << 30;

/// The inode, the length and the modification time of a file. They change when the content changes, so the content need
/// not be compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Stamp {
    inode: u64,
    length: u64,
    changed: (i64, i64),
}

impl Stamp {
    /// Returns the stamp of the file at `path`, or `None` if it does not exist.
    pub fn read(path: &Path) -> Option<Self> {
        std::fs::metadata(path).ok().as_ref().map(Self::from_metadata)
    }

    /// Returns the stamp of the file with this metadata.
    pub fn from_metadata(file: &Metadata) -> Self {
        Self { inode: file.ino(), length: file.len(), changed: (file.mtime(), file.mtime_nsec()) }
    }

    /// Returns the stamp as text that needs no escaping in URLs.
    pub fn tag(&self) -> String {
        let Self { inode, length, changed: (seconds, nanoseconds) } = self;
        format!("{inode:x}-{length:x}-{seconds:x}-{nanoseconds:x}")
    }

    /// Returns the modification time, in seconds since 1970.
    pub fn seconds(&self) -> i64 {
        self.changed.0
    }

    /// Returns the inode number.
    pub fn inode(&self) -> u64 {
        self.inode
    }

    /// Returns the length of the file, in bytes.
    pub fn length(&self) -> u64 {
        self.length
    }
}

/// Reads a regular file of at most `most` bytes. Returns `None` if it does not exist.
///
/// # Errors
/// An error of the operating system, or an error if the file is not regular or longer than `most`.
pub fn read_plain(path: &Path, most: u64) -> Result<Option<Vec<u8>>> {
    if_there(perturb_system::read_plain(path, most)).map_err(io("read", path))
}

/// Reads a regular file of at most `most` bytes as UTF-8 text.
///
/// # Errors
/// The errors of [`read_plain`], or an error if the file does not exist or is not UTF-8.
pub fn read_plain_text(path: &Path, most: u64) -> Result<String> {
    let content = read_plain(path, most)?.ok_or_else(|| io("read", path)(Errno::NOENT.into()))?;
    String::from_utf8(content).map_err(|error| io("read", path)(Error::new(ErrorKind::InvalidData, error.utf8_error())))
}

/// Returns whether the path `name` in `folder` passes a symbolic link that leads out of `root`, or to a hidden file or
/// folder in `root`. `folder` must be inside of `root` and must not contain symbolic links.
pub fn escapes_root(root: &Path, folder: &Path, name: impl AsRef<Path>) -> bool {
    let mut path = folder.to_owned();
    name.as_ref().components().any(|component| {
        path.push(component);
        path.is_symlink() && is_elsewhere(root, &path)
    })
}

fn is_elsewhere(root: &Path, path: &Path) -> bool {
    let real = match path.canonicalize() {
        Err(error) => return error.kind() != ErrorKind::NotFound, // a dangling link leads nowhere
        Ok(real) => real,
    };
    let hidden = |name: &std::ffi::OsStr| name.as_encoded_bytes().starts_with(b".");
    real.strip_prefix(root).map_or(true, |inside| inside.iter().any(hidden))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::process::Command;

    use super::*;

    #[test]
    fn a_pipe_is_refused_and_is_no_fault() {
        let directory = tempfile::tempdir().unwrap();
        let pipe = directory.path().join("pipe");
        assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let error = read_plain(&pipe, MAX_BYTES).unwrap_err();
        assert!(error.to_string().contains("it is a pipe") && !error.is_fault(), "{error}");
        assert!(super::super::read_if_exists(&pipe).is_err());
    }

    #[test]
    fn no_more_is_read_than_is_allowed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        assert_eq!(read_plain(&path, 3).unwrap(), None);
        std::fs::write(&path, "abc").unwrap();
        assert_eq!(read_plain(&path, 3).unwrap().unwrap(), b"abc");
        let error = read_plain(&path, 2).unwrap_err().to_string();
        assert!(error.contains("it has 3 bytes, expected 2 at most"), "{error}");
        std::fs::write(&path, b"\xff").unwrap();
        assert!(read_plain_text(&path, 9).unwrap_err().to_string().contains("utf-8"));
    }

    #[test]
    fn links_are_followed_no_further_than_the_folder() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().canonicalize().unwrap().join("root");
        let run = root.join("run");
        std::fs::create_dir_all(run.join("inner")).unwrap();
        for name in ["../../out", "../.hidden", "file", "inner/file"] {
            std::fs::write(run.join(name), "x").unwrap();
        }
        for (to, name) in [("../../out", "a"), ("../.hidden", "b"), ("file", "c"), ("nothing", "d"), ("../..", "e")] {
            symlink(to, run.join(name)).unwrap();
        }
        let out =
            ["a", "b", "c", "d", "e/out", "file", "inner/file", "missing"].map(|name| escapes_root(&root, &run, name));
        assert_eq!(out, [true, true, false, false, true, false, false, false]);
    }
}
