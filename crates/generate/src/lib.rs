//! The generated files of the repository: the Rust code of the protocols and the bindings of MuJoCo.
//!
//! The repository contains these files so that building perturb needs neither a generator nor libclang. This package's
//! build script generates them, `make generate` copies them into the repository, and a test fails if a copy is out of
//! date.
#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};
use std::{fs, io};

/// Folders with generated files, relative to the repository's root.
const FOLDERS: [&str; 2] = ["crates/protocol/src/generated", "crates/mujoco/src"];

/// A generated file with its intended content.
#[derive(Debug)]
pub struct GeneratedFile {
    /// Path relative to the repository's root.
    pub path: PathBuf,
    /// The bytes that the file should contain.
    pub content: Vec<u8>,
}

impl GeneratedFile {
    /// Returns the path of the file's copy in the repository.
    pub fn copy(&self) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(&self.path)
    }

    /// Returns whether the copy in the repository has this content.
    pub fn is_up_to_date(&self) -> bool {
        fs::read(self.copy()).is_ok_and(|content| content == self.content)
    }
}

/// Returns the files that the build script has generated.
///
/// # Errors
/// An error if a file cannot be read.
pub fn generated() -> io::Result<Vec<GeneratedFile>> {
    let out = Path::new(env!("OUT_DIR"));
    let mut files = Vec::new();
    for folder in FOLDERS {
        for entry in fs::read_dir(out.join(folder))? {
            let entry = entry?;
            files.push(GeneratedFile {
                path: Path::new(folder).join(entry.file_name()),
                content: fs::read(entry.path())?,
            });
        }
    }
    Ok(files)
}
