//! Files: errors that contain the path, atomic writing, locks and checksums.
#![forbid(unsafe_code)]

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use rustix::io::Errno;
use serde::Serialize;
use tempfile::NamedTempFile;

use perturb_system::support::{Operation, unless_unsupported};
use perturb_text::quoted;

pub mod checksum;
pub mod interrupt;
mod lock;
mod plain;

pub use self::lock::{Lock, is_locked};
pub use self::plain::{Stamp, escapes_root, read_plain, read_plain_text};
pub use perturb_system::open_plain;

/// The prefix of the names of temporary files, which are renamed after they are complete.
pub const TEMPORARY_PREFIX: &str = ".tmp-";
/// Maximum size of a TOML file, in bytes. The parser's memory can be about 200 times the size of the file.
pub const MAX_TOML_BYTES: u64 = 256 << 10;

/// A boxed error of any type, for callers that only display it.
pub type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// An error of the operating system, with the path of the file.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {}: {source}", path.display())]
pub struct FileError {
    /// The attempted action, e.g. "read".
    pub action: &'static str,
    /// The path of the file or folder.
    pub path: PathBuf,
    /// The operating system's error.
    pub source: std::io::Error,
}

impl FileError {
    /// Returns whether the cause is a fault of the machine, e.g. a full disk or a lost mount. Otherwise the cause is
    /// the content of a folder, e.g. a missing file.
    pub fn is_fault(&self) -> bool {
        use ErrorKind::{AlreadyExists, InvalidData, InvalidInput, IsADirectory, NotADirectory, NotFound};
        let kind = self.source.kind();
        !matches!(kind, AlreadyExists | InvalidData | InvalidInput | IsADirectory | NotADirectory | NotFound)
    }
}

/// A result with [`FileError`] as its error.
pub type Result<T> = std::result::Result<T, FileError>;

/// Returns a function that adds the action and the path to an error of the operating system.
pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> FileError {
    let path = path.to_owned();
    move |source| FileError { action, path, source }
}

/// Reads a regular file, which must exist.
///
/// # Errors
/// An error of the operating system, or an error if the path is a pipe or a device, or if the file is longer than 1
/// GiB.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    read_if_exists(path)?.ok_or_else(|| io("read", path)(Errno::NOENT.into()))
}

/// Reads the text of a TOML file.
///
/// # Errors
/// An error of the operating system, or an error if the path is a pipe or a device, or if the file is longer than
/// [`MAX_TOML_BYTES`] or not UTF-8.
pub fn read_toml(path: &Path) -> Result<String> {
    read_plain_text(path, MAX_TOML_BYTES)
}

/// Reads a regular file. Returns `None` if it does not exist.
///
/// # Errors
/// An error of the operating system, or an error if the path is a pipe or a device, or if the file is longer than 1
/// GiB.
pub fn read_if_exists(path: &Path) -> Result<Option<Vec<u8>>> {
    read_plain(path, plain::MAX_BYTES)
}

/// Returns the metadata of a path, or `None` if it does not exist. A failure of the file system is an error instead of
/// `None`.
///
/// # Errors
/// An error of the operating system.
pub fn metadata_if_exists(path: &Path) -> Result<Option<fs::Metadata>> {
    match fs::metadata(path).map_err(io("look for", path)) {
        Ok(metadata) => Ok(Some(metadata)),
        Err(error) if error.is_fault() => Err(error),
        Err(_) => Ok(None),
    }
}

/// Returns whether `path` is a regular file.
///
/// # Errors
/// The errors of [`metadata_if_exists`].
pub fn has_file(path: &Path) -> Result<bool> {
    Ok(metadata_if_exists(path)?.is_some_and(|metadata| metadata.is_file()))
}

/// Creates a folder and all its missing parents.
///
/// # Errors
/// An error of the operating system.
pub fn create_folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(io("create", path))
}

/// Returns the sorted paths of all files and folders in a folder; an empty list if the folder does not exist.
///
/// # Errors
/// An error of the operating system.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let list = || fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<PathBuf>>>();
    let mut paths = if_there(list()).map_err(io("list", folder))?.unwrap_or_default();
    paths.sort();
    Ok(paths)
}

/// Returns an error unless `path` is a readable folder.
///
/// # Errors
/// An error of the operating system.
pub fn require_folder(path: &Path) -> Result<()> {
    fs::read_dir(path).map(drop).map_err(io("list", path))
}

/// Deletes a file, or a folder with its content. Does nothing if the path does not exist.
///
/// # Errors
/// An error of the operating system.
pub fn delete(path: &Path) -> Result<()> {
    let deleted = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    if_there(deleted).map(drop).map_err(io("delete", path))
}

/// Writes a file atomically: after a crash or a failure the file is either complete and on disk, or unchanged. Creates
/// missing folders. If `path` is not a regular file, e.g. a pipe, the content is written to it directly.
///
/// # Errors
/// An error of the operating system. An earlier file then still exists.
pub fn write_atomically(path: &Path, content: &[u8]) -> Result<()> {
    if path.metadata().is_ok_and(|metadata| !metadata.is_file()) {
        return fs::write(path, content).map_err(io("write", path));
    }
    create_folder(folder_of(path))?;
    let mut file = temporary_beside(path, TEMPORARY_PREFIX)?;
    file.write_all(content).map_err(io("write", path))?;
    replace(file, path)
}

/// Creates a hidden temporary file in the folder of `path`, which must exist. The file's name begins with `prefix`.
///
/// # Errors
/// An error of the operating system.
pub fn temporary_beside(path: &Path, prefix: &str) -> Result<NamedTempFile> {
    // Gives the file the usual permissions of new files. By default, only the owner could read it.
    let mode = <fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666);
    let folder = folder_of(path);
    tempfile::Builder::new().prefix(prefix).permissions(mode).tempfile_in(folder).map_err(io("write in", folder))
}

/// Creates a temporary file without a name. It is deleted when it is closed.
///
/// # Errors
/// An error of the operating system. Its message recommends the variable `TMPDIR`.
pub fn temporary_file() -> std::io::Result<File> {
    tempfile::tempfile().map_err(|error| {
        let folder = std::env::temp_dir();
        let words = format!("no temporary file in {} ({error}): set TMPDIR to another folder", folder.display());
        std::io::Error::new(error.kind(), words)
    })
}

/// Renames a complete temporary file to `path`. Afterwards the content and the name are on disk. If the file system
/// does not support renaming, copies the content instead.
///
/// # Errors
/// An error of the operating system.
pub fn replace(file: NamedTempFile, path: &Path) -> Result<()> {
    sync_file(file.as_file(), path).map_err(io("write", path))?;
    if let Err(error) = file.persist(path) {
        let tempfile::PersistError { error, file } = error;
        unless_unsupported(Operation::Rename, Err::<(), _>(error), path).map_err(io("rename a file to", path))?;
        copy(&file, path).map_err(io("write", path))?;
    }
    sync_folder(folder_of(path))
}

/// Copies the content of a temporary file to `path`, but not its permissions.
fn copy(file: &NamedTempFile, path: &Path) -> std::io::Result<()> {
    let mut copy = File::create(path)?;
    std::io::copy(&mut file.reopen()?, &mut copy)?;
    sync_file(&copy, path)
}

/// Returns the folder of the file at `path`.
fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Checks in advance that [`write_atomically`] can write to `path`: that the folder exists and is writable.
///
/// # Errors
/// [`FileError`] with advice to the user.
pub fn require_writable(path: &Path) -> Result<()> {
    let refuse = |kind, words: String| Err(io("write", path)(std::io::Error::new(kind, words)));
    let folder = folder_of(path);
    match path.metadata() {
        Ok(metadata) if metadata.is_dir() => {
            return refuse(ErrorKind::IsADirectory, "it is a folder; give the name of a file".into());
        }
        Ok(metadata) if !metadata.is_file() => return Ok(()), // for example a pipe or a terminal
        Err(error) if error.kind() == ErrorKind::InvalidFilename => return Err(io("write", path)(error)), // too long
        _ => {}
    }
    if !folder.is_dir() {
        let (kind, words) = match folder.exists() {
            true => (ErrorKind::NotADirectory, format!("{} is not a folder", folder.display())),
            false => {
                let command = format!("mkdir -p {}", quoted(folder));
                (ErrorKind::NotFound, format!("there is no folder {}; make it with `{command}`", folder.display()))
            }
        };
        return refuse(kind, words);
    }
    tempfile::tempfile_in(folder).map(drop).map_err(io("write", path))
}

/// Checks in advance that files can be written to `folder`. If `folder` does not exist, checks its nearest existing
/// parent.
///
/// # Errors
/// [`FileError`] if no file can be created there.
pub fn require_writable_folder(folder: &Path) -> Result<()> {
    let existing = folder.ancestors().find(|path| path.is_dir()).unwrap_or(Path::new("."));
    tempfile::Builder::new().prefix(TEMPORARY_PREFIX).tempfile_in(existing).map(drop).map_err(io("write in", folder))
}

/// Writes a document as a JSON file, atomically.
///
/// # Errors
/// An error of the operating system.
pub fn write_json(path: &Path, document: &impl Serialize) -> Result<()> {
    let mut text = serde_json::to_vec_pretty(document).map_err(|error| io("write", path)(error.into()))?;
    text.push(b'\n');
    write_atomically(path, &text)
}

/// Flushes the list of a folder's files to the disk, if the file system supports this. Without it, a new or renamed
/// file may be lost if the machine crashes.
///
/// # Errors
/// An error of the operating system.
pub fn sync_folder(path: &Path) -> Result<()> {
    let synced = match File::open(path) {
        // A folder that is writable but not readable cannot be opened, and is not flushed.
        Err(error) if error.kind() == ErrorKind::PermissionDenied => Ok(()),
        opened => opened.and_then(|folder| folder.sync_all()),
    };
    unless_unsupported(Operation::Sync, synced, path).map(drop).map_err(io("sync", path))
}

/// Flushes the content of `file`, which is at `path`, to the disk, if the file system supports this.
///
/// # Errors
/// An error of the operating system.
pub fn sync_file(file: &File, path: &Path) -> std::io::Result<()> {
    unless_unsupported(Operation::Sync, file.sync_all(), path).map(drop)
}

/// Replaces the error "not found" by `None`.
fn if_there<T>(result: std::io::Result<T>) -> std::io::Result<Option<T>> {
    match result {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        result => result.map(Some),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_is_written_whole_is_as_readable_as_others() {
        use std::os::unix::fs::PermissionsExt;
        let directory = tempfile::tempdir().unwrap();
        let [plain, whole] = ["plain", "whole"].map(|name| directory.path().join(name));
        fs::write(&plain, "x").unwrap();
        write_atomically(&whole, b"x").unwrap();
        let [plain, whole] = [plain, whole].map(|path| fs::metadata(path).unwrap().permissions().mode());
        assert_eq!(plain, whole);
    }

    #[test]
    fn whether_a_file_can_be_written_is_known_before_it_is() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        fs::write(path("file"), "x").unwrap();
        let long = "a".repeat(256);
        for (name, words) in [
            ("", "it is a folder"),
            ("no/file", "mkdir -p "),
            ("file/file", "is not a folder"),
            (&long, "File name too long"),
        ] {
            let error = require_writable(&path(name)).unwrap_err().to_string();
            assert!(error.starts_with("cannot write ") && error.contains(words), "{name}: {error}");
        }
        assert!(["new", "file"].iter().all(|name| require_writable(&path(name)).is_ok()));
        require_writable(Path::new("/dev/null")).unwrap();
        assert_eq!(list(directory.path()).unwrap(), [path("file")], "nothing is made");
    }

    #[test]
    fn what_is_not_there_is_no_error_where_that_is_asked() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("nothing");
        assert_eq!(read_if_exists(&path).unwrap(), None);
        assert!(metadata_if_exists(&path).unwrap().is_none() && !has_file(&path.join("file")).unwrap());
        assert!(!has_file(directory.path()).unwrap(), "a folder");
        assert!(list(&path).unwrap().is_empty());
        delete(&path).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.starts_with("cannot read ") && error.contains("/nothing: No such file"), "{error}");
    }

    #[test]
    fn toml_beyond_a_limit_is_not_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("plan.toml");
        fs::write(&path, vec![b'#'; MAX_TOML_BYTES as usize]).unwrap();
        assert_eq!(read_toml(&path).unwrap().len() as u64, MAX_TOML_BYTES);
        fs::write(&path, vec![b'#'; MAX_TOML_BYTES as usize + 1]).unwrap();
        assert!(read_toml(&path).unwrap_err().to_string().contains("it has 262145 bytes, expected 262144 at most"));
    }

    #[test]
    fn a_file_replaces_another_also_by_copying() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        fs::write(&path, "the longer one before").unwrap();
        let mut file = temporary_beside(&path, TEMPORARY_PREFIX).unwrap();
        file.write_all(b"new").unwrap();
        copy(&file, &path).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        file.write_all(b"er").unwrap();
        replace(file, &path).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"newer");
        assert_eq!(list(directory.path()).unwrap(), [path], "nothing temporary");
    }

    #[test]
    fn that_the_system_cannot_tell_is_not_taken_for_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("loop");
        std::os::unix::fs::symlink(&path, &path).unwrap();
        let error = has_file(&path).unwrap_err();
        assert!(error.is_fault() && error.to_string().starts_with("cannot look for "), "{error}");
    }

    #[rstest::rstest]
    #[case::enospc(28, true)]
    #[case::eio(5, true)]
    #[case::edquot(122, true)]
    #[case::estale(116, true)]
    #[case::erofs(30, true)]
    #[case::eperm(1, true)]
    #[case::eacces(13, true)]
    #[case::emfile(24, true)]
    #[case::enoent(2, false)]
    #[case::eexist(17, false)]
    #[case::eisdir(21, false)]
    #[case::enotdir(20, false)]
    fn the_machines_faults_are_told_from_what_is_in_a_folder(#[case] code: i32, #[case] is_fault: bool) {
        let error = io("read", Path::new("file"))(std::io::Error::from_raw_os_error(code));
        assert_eq!(error.is_fault(), is_fault, "{error}");
    }
}
