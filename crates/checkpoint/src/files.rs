//! The files of a checkpoint: written whole or not at all, read only if they are what was written.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use perturb_files::{self as files, TEMPORARY_PREFIX, checksum, write_atomically};
use serde::{Deserialize, Serialize};

use super::{CheckpointError, Result};

const ARRAYS_SUFFIX: &str = ".safetensors";

/// Names a file of arrays and says how to tell whether it is whole.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArraysFile {
    pub(super) file: String,
    bytes: u64,
    crc32c: u32,
}

impl ArraysFile {
    /// Writes `content` to a file with a unique name, which begins with `prefix`: [`RESUME_PREFIX`](super::RESUME_PREFIX) or
    /// the prefix of weights.
    ///
    /// # Errors
    /// The operating system's.
    pub fn write(directory: &Path, prefix: &str, iterations: u64, content: &[u8]) -> Result<Self> {
        let file = Self::describe(prefix, iterations, content);
        write_atomically(&directory.join(&file.file), content)?;
        Ok(file)
    }

    /// Describes `content` as [`ArraysFile::write`] does, without writing it.
    pub(super) fn describe(prefix: &str, iterations: u64, content: &[u8]) -> Self {
        let crc32c = crc32c::crc32c(content);
        // The checksum is part of the name: a file that is in use is never written over by another content.
        let file = format!("{prefix}{iterations:08}-{crc32c:08x}{ARRAYS_SUFFIX}");
        Self { file, bytes: content.len() as u64, crc32c }
    }

    /// Returns the file's path. The file is always in `directory`, whatever folder its name has.
    pub fn path(&self, directory: &Path) -> PathBuf {
        directory.join(Path::new(&self.file).file_name().unwrap_or_default())
    }

    /// Makes sure that the file is there, is a plain file, and has the length that was written.
    ///
    /// # Errors
    /// [`CheckpointError`].
    pub(super) fn require(&self, directory: &Path) -> Result<()> {
        self.open(directory).map(drop)
    }

    /// Reads the file and checks its length, before anything is read, and its checksum.
    ///
    /// # Errors
    /// [`CheckpointError`], also if the checksum does not match.
    pub fn read(&self, directory: &Path) -> Result<Vec<u8>> {
        let path = self.path(directory);
        let mut content = Vec::new();
        let mut file = self.open(directory)?.take(self.bytes.saturating_add(1)); // it may grow meanwhile
        file.read_to_end(&mut content).map_err(files::io("read", &path))?;
        self.require_content(&content).map_err(|reason| damaged(&path, reason))?;
        Ok(content)
    }

    fn open(&self, directory: &Path) -> Result<File> {
        let path = self.path(directory);
        let (file, metadata) = files::open_plain(&path).map_err(files::io("read", &path))?;
        let length = metadata.len();
        if length == self.bytes {
            Ok(file)
        } else {
            Err(damaged(&path, format!("it has {length} bytes, expected {}", self.bytes)))
        }
    }

    /// Checks length and checksum of `content`.
    ///
    /// # Errors
    /// A description of the difference.
    pub(super) fn require_content(&self, content: &[u8]) -> std::result::Result<(), String> {
        if content.len() as u64 == self.bytes && crc32c::crc32c(content) == self.crc32c {
            return Ok(());
        }
        let has_length = content.len() as u64 == self.bytes;
        let damaged = || format!("it has {} bytes, expected {}", content.len(), self.bytes);
        Err(if has_length { checksum::CHECKSUM_MISMATCH.into() } else { damaged() })
    }
}

/// Deletes files of arrays, beginning with one of `prefixes`, that are not `current`, and what broken-off writes left.
pub(super) fn remove_others(directory: &Path, prefixes: &[&str], current: &[&str]) -> files::Result<()> {
    for path in files::list(directory)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let arrays = prefixes.iter().any(|prefix| name.starts_with(prefix)) && name.ends_with(ARRAYS_SUFFIX);
        if (arrays && !current.contains(&name.as_ref())) || name.starts_with(TEMPORARY_PREFIX) {
            files::delete(&path)?;
        }
    }
    Ok(())
}

/// Names the file that `reason` makes unusable.
pub fn damaged(path: &Path, reason: String) -> CheckpointError {
    CheckpointError::Damaged { path: path.to_owned(), reason }
}
