//! Flushes logs to the disk.

use std::fs::File;

/// Flushes `file` to the disk and returns its length.
pub(super) fn sync(file: &File) -> std::io::Result<u64> {
    file.sync_data()?;
    Ok(file.metadata()?.len())
}
