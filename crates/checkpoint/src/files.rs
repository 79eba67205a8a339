//! The files of arrays in a checkpoint. They are written atomically, and their checksums are compared when they are
//! read.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use perturb_files::{self as files, TEMPORARY_PREFIX, checksum, write_atomically};
use serde::{Deserialize, Serialize};

use super::{CheckpointError, Result};

const ARRAYS_SUFFIX: &str = ".safetensors";

/// The entry for a file of arrays in `checkpoint.json`: its name, its length and its checksum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArraysFile {
    pub(super) file: String,
    bytes: u64,
    crc32c: u32,
}

impl ArraysFile {
    /// Writes `content` to a file in `directory` and returns its entry. The file's name is unique and begins with
    /// `prefix`, which is [`RESUME_PREFIX`](super::RESUME_PREFIX) or the prefix of weights.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn write(directory: &Path, prefix: &str, iterations: u64, content: &[u8]) -> Result<Self> {
        let file = Self::describe(prefix, iterations, content);
        write_atomically(&directory.join(&file.file), content)?;
        Ok(file)
    }

    /// Returns the entry that [`ArraysFile::write`] would return for `content`, without writing a file.
    pub(super) fn describe(prefix: &str, iterations: u64, content: &[u8]) -> Self {
        let crc32c = crc32c::crc32c(content);
        // The name contains the checksum, so a file in use is never overwritten by other content.
        let file = format!("{prefix}{iterations:08}-{crc32c:08x}{ARRAYS_SUFFIX}");
        Self { file, bytes: content.len() as u64, crc32c }
    }

    /// Returns the path of the file in `directory`. Ignores any folder in the stored name.
    pub fn path(&self, directory: &Path) -> PathBuf {
        directory.join(Path::new(&self.file).file_name().unwrap_or_default())
    }

    /// Checks that the file exists, is a regular file and has the right length.
    ///
    /// # Errors
    /// [`CheckpointError`] if it does not.
    pub(super) fn require(&self, directory: &Path) -> Result<()> {
        self.open(directory).map(drop)
    }

    /// Reads the file. Checks its length before reading, and its checksum afterwards.
    ///
    /// # Errors
    /// [`CheckpointError`] if the file cannot be read, or if its length or checksum is wrong.
    pub fn read(&self, directory: &Path) -> Result<Vec<u8>> {
        let path = self.path(directory);
        let mut content = Vec::new();
        // Another process may append to the file meanwhile, so no more than one extra byte is read.
        let mut file = self.open(directory)?.take(self.bytes.saturating_add(1));
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

    /// Checks the length and the checksum of `content`.
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

/// Deletes the files of arrays that begin with one of `prefixes` and are not in `current`. Also deletes temporary files
/// of interrupted writes.
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

/// Creates the error for an unusable file with its `path` and the `reason`.
pub fn damaged(path: &Path, reason: String) -> CheckpointError {
    CheckpointError::Damaged { path: path.to_owned(), reason }
}
