//! Flushes logs to the disk.

use std::fs::File;
use std::path::Path;

use perturb_files::sync_file;

/// Flushes the log `name` to the disk and returns its length.
pub(super) fn sync(file: &File, name: &str) -> std::io::Result<u64> {
    sync_file(file, Path::new(name))?;
    Ok(file.metadata()?.len())
}
