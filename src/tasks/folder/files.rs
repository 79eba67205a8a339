//! Reads the files of a task's folder. Each file is read once, within limits of size, and no file outside of the folder
//! is read. The hash of the task covers all of them.

use super::error::{Error, Result, escaped};
use sha2::{Digest, Sha256};
use std::{
    collections::BTreeMap,
    fmt::Write,
    io::Read,
    path::{Component, Path, PathBuf},
    time::SystemTime,
};

/// The name of the file that describes the task.
pub(super) const TASK: &str = "task.toml";
/// Maximal total size of the files of a folder that are read, in bytes.
const MAX_BYTES: u64 = 64 << 20;
/// Maximal number of files of a folder that are read. MuJoCo accepts 1999 in addition to the model's text.
const MAX_FILES: usize = 1900;
/// Maximal size of `task.toml`, in bytes.
const MAX_TASK_BYTES: usize = 1 << 20;

/// A folder, and the contents of its files that were read so far, by their paths within the folder.
#[derive(Debug)]
pub(super) struct Files {
    root: PathBuf,
    read: BTreeMap<String, FileContent>,
    bytes: u64,
}

/// The content of a file, and its modification time when it was read.
#[derive(Debug)]
struct FileContent {
    bytes: Vec<u8>,
    modified: Option<SystemTime>,
}

impl Files {
    /// Opens a folder and reads its `task.toml`.
    ///
    /// # Errors
    /// [`Error`] if `folder` is not a folder, or its `task.toml` cannot be read or is too large.
    pub(super) fn open(folder: &Path) -> Result<Self> {
        let refuse = |problem: String| Error::folder(problem);
        let root = folder.canonicalize().map_err(|error| refuse(format!("the folder cannot be opened: {error}")))?;
        if !root.is_dir() {
            return Err(refuse("this is not a folder; give the folder that holds task.toml".into()));
        }
        if !root.join(TASK).exists() {
            return Err(refuse("the folder has no task.toml; docs/tasks.md describes this file".into()));
        }
        let mut files = Self { root, read: BTreeMap::new(), bytes: 0 };
        if files.read(TASK, "the folder")?.len() > MAX_TASK_BYTES {
            return Err(Error::file(TASK, "the file is longer than 1 MiB"));
        }
        Ok(files)
    }

    /// The content of `task.toml`.
    pub(super) fn task(&self) -> &[u8] {
        self.read.get(TASK).map_or(&[], |file| file.bytes.as_slice())
    }

    /// Returns the content of the file at a path within the folder, and reads it if it was not read before. `who` tells
    /// in error messages which file refers to this file, for instance `robot.xml, line 12`.
    ///
    /// # Errors
    /// [`Error`] if the path leaves the folder, if the file cannot be read, or if a limit is exceeded.
    pub(super) fn read(&mut self, path: &str, who: &str) -> Result<&[u8]> {
        let name = self.resolve(path, who)?;
        if !self.read.contains_key(&name) {
            let content = self.read_from_disk(&name, who)?;
            self.read.insert(name.clone(), content);
        }
        Ok(self.read.get(&name).map_or(&[], |file| file.bytes.as_slice()))
    }

    /// Resolves `.`, `..` and links in a path within the folder. The result must be inside the folder.
    fn resolve(&self, path: &str, who: &str) -> Result<String> {
        let shown = escaped(path);
        let refuse = |problem: &str| Error::folder(format_args!("{who} names the file {shown:?}, which {problem}"));
        let outside = "is outside of the folder; put the file into the folder and name it by a relative path";
        let relative = Path::new(path);
        if relative.components().any(|part| matches!(part, Component::RootDir | Component::Prefix(_))) {
            return Err(refuse(outside));
        }
        let found = self.root.join(relative).canonicalize();
        let found = found.map_err(|error| refuse(&format!("cannot be read: {error}")))?;
        let inside = found.strip_prefix(&self.root).map_err(|_| refuse(outside))?;
        inside.to_str().map(str::to_owned).ok_or_else(|| refuse("has a name that is not UTF-8; rename it"))
    }

    fn read_from_disk(&mut self, name: &str, who: &str) -> Result<FileContent> {
        let path = self.root.join(name);
        let shown = escaped(name);
        let refuse = |problem: String| Error::folder(format_args!("{who} names the file {shown:?}, which {problem}"));
        let unreadable = |error: std::io::Error| refuse(format!("cannot be read: {error}"));
        let about = path.metadata().map_err(unreadable)?;
        if !about.is_file() {
            return Err(refuse("is not a regular file".into()));
        }
        let mut bytes = Vec::new();
        let room = MAX_BYTES - self.bytes;
        std::fs::File::open(&path).and_then(|file| file.take(room + 1).read_to_end(&mut bytes)).map_err(unreadable)?;
        if bytes.len() as u64 > room {
            return Err(Error::folder("the files that the task needs exceed 64 MiB in total"));
        }
        if self.read.len() >= MAX_FILES {
            return Err(Error::folder(format_args!("more than {MAX_FILES} files of the folder are read")));
        }
        self.bytes += bytes.len() as u64;
        Ok(FileContent { bytes, modified: about.modified().ok() })
    }

    /// Returns a hash of all files that were read, in hexadecimal. The SHA-256 covers for each file the length of its
    /// path (8 bytes, little-endian), the path, and the SHA-256 of the content. `task.toml` comes first, then the other
    /// files, ordered by path.
    pub(super) fn hash(&self) -> String {
        let task = self.read.get_key_value(TASK);
        let others = self.read.iter().filter(|(name, _)| *name != TASK);
        let mut all = Sha256::new();
        for (name, FileContent { bytes, .. }) in task.into_iter().chain(others) {
            all.update((name.len() as u64).to_le_bytes());
            all.update(name.as_bytes());
            all.update(Sha256::digest(bytes));
        }
        hexadecimal(&all.finalize())
    }

    /// Reads all files again. Returns whether they still have the contents that were read before.
    pub(super) fn are_unchanged(&self) -> bool {
        self.read.iter().all(|(name, file)| self.is_unchanged(name, file))
    }

    /// Like [`Files::are_unchanged`], but reads only files whose modification time has changed.
    pub(super) fn have_unchanged_times(&self) -> bool {
        let is_as_old = |name: &str, file: &FileContent| {
            let modified = self.root.join(name).metadata().and_then(|about| about.modified()).ok();
            modified.is_some() && modified == file.modified
        };
        self.read.iter().all(|(name, file)| is_as_old(name, file) || self.is_unchanged(name, file))
    }

    fn is_unchanged(&self, name: &str, file: &FileContent) -> bool {
        let path = self.root.join(name);
        let has_length = path.metadata().is_ok_and(|about| about.len() == file.bytes.len() as u64);
        has_length && std::fs::read(&path).is_ok_and(|now| now == file.bytes)
    }

    /// The paths, within the folder, of the files that were read.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.read.keys().map(String::as_str)
    }

    /// The total size of the files that were read, in bytes.
    pub(super) fn n_bytes(&self) -> u64 {
        self.bytes
    }
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}"); // writing to a String cannot fail
        text
    })
}
