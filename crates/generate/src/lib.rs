//! The generated files of the repository: the Rust code of the protocols, and the bindings of MuJoCo.
//!
//! The repository contains these files, so that a build of perturb compiles no generator and needs no libclang. This
//! package's build script generates them; `make generate` copies them into the repository, and a test fails where a copy is
//! out of date.
#![forbid(unsafe_code)]

use std::path::{Path, PathBuf};
use std::{fs, io};

/// Folders that contain generated files, from the repository's root.
const FOLDERS: [&str; 2] = ["crates/protocol/src/generated", "crates/mujoco/src"];

/// A generated file.
#[derive(Debug)]
pub struct GeneratedFile {
    /// Path from the repository's root.
    pub path: PathBuf,
    /// Bytes that the file should have.
    pub content: Vec<u8>,
}

impl GeneratedFile {
    /// Path of the file's copy in the repository.
    pub fn copy(&self) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(&self.path)
    }

    /// Whether the repository's copy has these bytes.
    pub fn is_up_to_date(&self) -> bool {
        fs::read(self.copy()).is_ok_and(|content| content == self.content)
    }
}

/// Returns the files that the build script has generated.
///
/// # Errors
/// A file cannot be read.
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
