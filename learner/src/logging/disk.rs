//! Bringing a log to the disk.

use std::fs::File;

/// Brings `file` to the disk and gives its length.
pub(super) fn sync(file: &File) -> std::io::Result<u64> {
    file.sync_data()?;
    Ok(file.metadata()?.len())
}
