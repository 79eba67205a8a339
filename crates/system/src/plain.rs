//! Plain files: opened without waiting, measured before they are read.

use std::fs::{File, Metadata};
use std::io::{Error, ErrorKind, Read, Result};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;

/// Opens a plain file for reading. A pipe or a device is refused: a pipe would be waited for, a device might never end.
///
/// # Errors
/// The operating system's; [`ErrorKind::InvalidInput`] for a pipe, a device or a socket, [`ErrorKind::IsADirectory`]
/// for a folder.
pub fn open_plain(path: &Path) -> Result<(File, Metadata)> {
    require_plain(&std::fs::metadata(path)?)?; // a device may do something when it is opened
    let file = File::options().read(true).custom_flags(nonblocking_flag()).open(path)?;
    let metadata = file.metadata()?;
    require_plain(&metadata)?; // another file may be at the path meanwhile
    Ok((file, metadata))
}

/// Reads a plain file of at most `max_bytes` bytes. Its size is compared before anything is read, and no more is read
/// if the file grows meanwhile.
///
/// # Errors
/// As those of [`open_plain`]; [`ErrorKind::InvalidData`] for a longer file.
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

/// Refuses all but plain files.
///
/// # Errors
/// [`ErrorKind::IsADirectory`] for a folder, [`ErrorKind::InvalidInput`] for anything else that is no plain file.
pub fn require_plain(metadata: &Metadata) -> Result<()> {
    match metadata.is_file() {
        true => Ok(()),
        false if metadata.is_dir() => Err(Error::new(ErrorKind::IsADirectory, "it is a folder, expected a file")),
        false => {
            let words = "it is a pipe or a device, expected a plain file; write the content to a file and name that";
            Err(Error::new(ErrorKind::InvalidInput, words))
        }
    }
}

/// The flag with which opening a pipe does not wait for its other end.
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
        // The length of what /proc has is 0.
        assert!(read_plain(Path::new("/proc/self/status"), 10).is_err());
    }
}
