//! Opens and reads plain files, without ever waiting for a pipe or reading an endless device.

use std::fs::{File, Metadata};
use std::io::{Error, ErrorKind, Read, Result};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;

/// Opens a plain file for reading. Refuses pipes, because opening one may wait for ever, and devices, because they may
/// be endless. Also returns the file's metadata.
///
/// # Errors
/// [`ErrorKind::IsADirectory`] for a folder, [`ErrorKind::InvalidInput`] for a pipe, a device or a socket, and errors
/// of the operating system.
pub fn open_plain(path: &Path) -> Result<(File, Metadata)> {
    require_plain(&std::fs::metadata(path)?)?; // checked before, because opening a device may have an effect
    let file = File::options().read(true).custom_flags(nonblocking_flag()).open(path)?;
    let metadata = file.metadata()?;
    require_plain(&metadata)?; // checked again, because the path may have been replaced
    Ok((file, metadata))
}

/// Reads a plain file of at most `max_bytes` bytes. Checks the size first, so a file that is too large is not read at
/// all. A file that grows while it is read is read only up to the limit.
///
/// # Errors
/// The errors of [`open_plain`], and [`ErrorKind::InvalidData`] for a file that is too large.
pub fn read_plain(path: &Path, max_bytes: u64) -> Result<Vec<u8>> {
    let (file, metadata) = open_plain(path)?;
    let mut content = Vec::new();
    let mut rest = file.take(max_bytes.saturating_add(1));
    if metadata.len() <= max_bytes {
        rest.read_to_end(&mut content)?;
    }
    let length = metadata.len().max(content.len() as u64);
    if length > max_bytes {
        let words = format!("it has {length} bytes, expected {max_bytes} at most");
        return Err(Error::new(ErrorKind::InvalidData, words));
    }
    Ok(content)
}

/// Checks that metadata belong to a plain file.
///
/// # Errors
/// [`ErrorKind::IsADirectory`] for a folder, [`ErrorKind::InvalidInput`] for a pipe, a device or a socket.
pub fn require_plain(metadata: &Metadata) -> Result<()> {
    match metadata.is_file() {
        true => Ok(()),
        false if metadata.is_dir() => Err(Error::new(ErrorKind::IsADirectory, "it is a folder, expected a file")),
        false => {
            let words = "it is a pipe or a device, expected a regular file; write the content to a file and name that";
            Err(Error::new(ErrorKind::InvalidInput, words))
        }
    }
}

/// Returns the flag `O_NONBLOCK` for opening a file. With this flag, opening a pipe does not wait until another process
/// opens the other end of the pipe.
pub fn nonblocking_flag() -> i32 {
    OFlags::NONBLOCK.bits().cast_signed()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::process::Command;

    use super::*;

    #[test]
    fn pipes_devices_and_folders_are_refused_without_waiting() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        assert!(Command::new("mkfifo").arg(path("pipe")).status().unwrap().success());
        symlink("/dev/zero", path("zeros")).unwrap();
        std::fs::create_dir(path("folder")).unwrap();
        for (name, words) in [("pipe", "it is a pipe"), ("zeros", "it is a pipe or a device"), ("folder", "a folder")] {
            let error = read_plain(&path(name), 1 << 30).unwrap_err().to_string();
            assert!(error.contains(words) && error.contains("expected"), "{name}: {error}");
        }
    }

    #[test]
    fn size_is_compared_before_anything_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        assert_eq!(read_plain(&path, 3).unwrap_err().kind(), ErrorKind::NotFound);
        std::fs::write(&path, "abc").unwrap();
        assert_eq!(read_plain(&path, 3).unwrap(), b"abc");
        let error = read_plain(&path, 2).unwrap_err().to_string();
        assert_eq!(error, "it has 3 bytes, expected 2 at most");
        let sparse = File::create(&path).unwrap();
        sparse.set_len(1 << 40).unwrap(); // reading it would take minutes
        assert!(read_plain(&path, 1 << 20).is_err());
        // Files in /proc have content, although their size is reported as 0.
        assert!(read_plain(Path::new("/proc/self/status"), 10).is_err());
    }
}
