//! Files: errors that name them, writing that happens wholly or not at all, locks.
#![forbid(unsafe_code)]

use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;

use perturb_system::plain::nonblocking_flag;
use perturb_text::quoted;

pub mod checksum;
pub mod interrupt;
mod plain;

pub use self::plain::{Stamp, leads_out, read_plain, read_plain_text};
pub use perturb_system::open_plain;

/// The prefix of files that a write has not finished.
pub const TEMPORARY_PREFIX: &str = ".tmp-";
/// Attempts to take a lock while another process only tests it.
const MAX_LOCK_TRIES: u32 = 100;
/// Time between two of these attempts. A test takes some microseconds.
const LOCK_RETRY_INTERVAL: Duration = Duration::from_millis(1);

/// A boxed error, for messages only.
pub type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// The operating system refused a file.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {}: {source}", path.display())]
pub struct FileError {
    /// The action, e.g. "read".
    pub action: &'static str,
    /// On what.
    pub path: PathBuf,
    /// The operating system's answer.
    pub source: std::io::Error,
}

impl FileError {
    /// Whether the machine is at fault, a full disk or a lost mount for instance, and not what is or is not in a folder.
    pub fn is_fault(&self) -> bool {
        use ErrorKind::{AlreadyExists, InvalidData, InvalidInput, IsADirectory, NotADirectory, NotFound};
        let kind = self.source.kind();
        !matches!(kind, AlreadyExists | InvalidData | InvalidInput | IsADirectory | NotADirectory | NotFound)
    }
}

/// A result with a [`FileError`].
pub type Result<T> = std::result::Result<T, FileError>;

/// Names the file in the operating system's error.
pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> FileError {
    let path = path.to_owned();
    move |source| FileError { action, path, source }
}

/// A file's content.
///
/// # Errors
/// The operating system's.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    fs::read(path).map_err(io("read", path))
}

/// A file's content as text.
///
/// # Errors
/// The operating system's; a file that is not UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    fs::read_to_string(path).map_err(io("read", path))
}

/// A plain file's content; `None` if it is not there.
///
/// # Errors
/// The operating system's; a pipe or a device, and what is larger than anything that a run writes.
pub fn read_if_there(path: &Path) -> Result<Option<Vec<u8>>> {
    read_plain(path, plain::MAX_BYTES)
}

/// Returns the metadata of a path, or `None` if nothing is there. A failure of the file system is an error, not `None`.
///
/// # Errors
/// The operating system's.
pub fn look(path: &Path) -> Result<Option<fs::Metadata>> {
    match fs::metadata(path).map_err(io("look for", path)) {
        Ok(metadata) => Ok(Some(metadata)),
        Err(error) if error.is_fault() => Err(error),
        Err(_) => Ok(None),
    }
}

/// Whether a plain file is at a path.
///
/// # Errors
/// As those of [`look`].
pub fn has_file(path: &Path) -> Result<bool> {
    Ok(look(path)?.is_some_and(|metadata| metadata.is_file()))
}

/// Creates a folder and those above it, unless they are there.
///
/// # Errors
/// The operating system's.
pub fn create_folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(io("create", path))
}

/// The paths in a folder, sorted; none if it is not there.
///
/// # Errors
/// The operating system's.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let list = || fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<PathBuf>>>();
    let mut paths = if_there(list()).map_err(io("list", folder))?.unwrap_or_default();
    paths.sort();
    Ok(paths)
}

/// Refuses a path that is no folder.
///
/// # Errors
/// The operating system's.
pub fn require_folder(path: &Path) -> Result<()> {
    fs::read_dir(path).map(drop).map_err(io("list", path))
}

/// Deletes a file, or a folder with everything in it, if it is there.
///
/// # Errors
/// The operating system's.
pub fn delete(path: &Path) -> Result<()> {
    let deleted = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    if_there(deleted).map(drop).map_err(io("delete", path))
}

/// Writes a file in one piece: it appears complete, and on the disk, or not at all. Folders are created. What is there
/// and is no plain file, a pipe for instance, is written to.
///
/// # Errors
/// The operating system's; an earlier file is then still there.
pub fn write_atomically(path: &Path, content: &[u8]) -> Result<()> {
    if path.metadata().is_ok_and(|metadata| !metadata.is_file()) {
        return fs::write(path, content).map_err(io("write", path));
    }
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    create_folder(folder)?;
    // As readable as any other file that is created here; temporary files are otherwise their owner's alone.
    let mode = <fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666);
    let mut builder = tempfile::Builder::new();
    let mut file =
        builder.prefix(TEMPORARY_PREFIX).permissions(mode).tempfile_in(folder).map_err(io("write in", folder))?;
    file.write_all(content).and_then(|()| file.as_file().sync_all()).map_err(io("write", path))?;
    file.persist(path).map_err(|error| io("rename a file to", path)(error.error))?;
    sync_folder(folder)
}

/// Makes sure, before there is anything to write, that [`write_atomically`] will find its folder and may write there.
///
/// # Errors
/// [`FileError`], with what to do.
pub fn require_writable(path: &Path) -> Result<()> {
    let refuse = |kind, words: String| Err(io("write", path)(std::io::Error::new(kind, words)));
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match path.metadata() {
        Ok(metadata) if metadata.is_dir() => {
            return refuse(ErrorKind::IsADirectory, "it is a folder; give the name of a file".into());
        }
        Ok(metadata) if !metadata.is_file() => return Ok(()), // a pipe, or a terminal
        _ => {}
    }
    if !folder.is_dir() {
        let (kind, words) = match folder.exists() {
            true => (ErrorKind::NotADirectory, format!("{} is no folder", folder.display())),
            false => {
                let command = format!("mkdir -p {}", quoted(folder));
                (ErrorKind::NotFound, format!("there is no folder {}; make it with `{command}`", folder.display()))
            }
        };
        return refuse(kind, words);
    }
    tempfile::tempfile_in(folder).map(drop).map_err(io("write", path))
}

/// Writes a document as JSON, in one piece.
///
/// # Errors
/// The operating system's.
pub fn write_json(path: &Path, document: &impl Serialize) -> Result<()> {
    let mut text = serde_json::to_vec_pretty(document).map_err(|error| io("write", path)(error.into()))?;
    text.push(b'\n');
    write_atomically(path, &text)
}

/// Brings the names in a folder to the disk.
///
/// # Errors
/// The operating system's.
pub fn sync_folder(path: &Path) -> Result<()> {
    File::open(path).and_then(|folder| folder.sync_all()).map_err(io("sync", path))
}

/// An advisory lock: it ends with the process that holds it, however it ends.
#[derive(Debug)]
pub struct Lock(File);

impl Drop for Lock {
    /// A process that is just being started has copies of all open files for a moment: closing this one does not unlock it.
    fn drop(&mut self) {
        let _ = self.0.unlock(); // a failure leaves it to the closing
    }
}

impl Lock {
    /// Takes the lock of the folder at `path`, or of a file, which is created if it is not there; `None` while somebody
    /// else has it. Who only asks whether [somebody has it](is_locked) does not count.
    ///
    /// # Errors
    /// The operating system's.
    pub fn try_take(path: &Path) -> Result<Option<Self>> {
        let file = if path.is_dir() {
            File::open(path)
        } else {
            // NFS wants both: to read for asking who has it, to write for having it.
            let mut options = File::options();
            options.create(true).truncate(false).read(true).write(true).custom_flags(nonblocking_flag()).open(path)
        };
        let file = file.map_err(io("open", path))?;
        for _ in 0..MAX_LOCK_TRIES {
            match file.try_lock() {
                Ok(()) => return Ok(Some(Self(file))),
                Err(TryLockError::WouldBlock) => {}
                Err(TryLockError::Error(source)) => return Err(io("lock", path)(source)),
            }
            // Who has it shares it with nobody; who only looks shares it with anybody.
            match file.try_lock_shared() {
                Ok(()) => file.unlock().map_err(io("unlock", path))?,
                Err(TryLockError::WouldBlock) => return Ok(None),
                Err(TryLockError::Error(source)) => return Err(io("lock", path)(source)),
            }
            std::thread::sleep(LOCK_RETRY_INTERVAL);
        }
        Ok(None)
    }
}

/// Whether somebody has the lock of the folder or file at `path`. It is shared for a moment, which
/// [keeps nobody from taking it](Lock::try_take).
pub fn is_locked(path: &Path) -> bool {
    let Ok(file) = File::options().read(true).custom_flags(nonblocking_flag()).open(path) else { return false };
    matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
}

/// `None` if what was asked for is not there.
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
    fn lock_ends_with_its_value_despite_inherited_files() {
        let directory = tempfile::tempdir().unwrap();
        let lock = Lock::try_take(directory.path()).unwrap().unwrap();
        let copy = lock.0.try_clone().unwrap(); // as a process gets it
        assert!(Lock::try_take(directory.path()).unwrap().is_none());
        drop(lock);
        assert!(Lock::try_take(directory.path()).unwrap().is_some());
        drop(copy);
    }

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
        for (name, words) in [("", "it is a folder"), ("no/file", "mkdir -p "), ("file/file", "is no folder")] {
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
        assert_eq!(read_if_there(&path).unwrap(), None);
        assert!(look(&path).unwrap().is_none() && !has_file(&path.join("file")).unwrap());
        assert!(!has_file(directory.path()).unwrap(), "a folder");
        assert!(list(&path).unwrap().is_empty());
        delete(&path).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.starts_with("cannot read ") && error.contains("/nothing: No such file"), "{error}");
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

    #[test]
    fn a_lock_is_had_while_others_look_whether_it_is_taken() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("lock");
        drop(Lock::try_take(&path).unwrap());
        let looks = File::open(&path).unwrap();
        looks.lock_shared().unwrap();
        let begun = std::time::Instant::now();
        assert!(Lock::try_take(&path).unwrap().is_none(), "who looks for ever");
        assert!(begun.elapsed() >= MAX_LOCK_TRIES * LOCK_RETRY_INTERVAL, "was waited for");
        looks.unlock().unwrap();
        let _lock = Lock::try_take(&path).unwrap().unwrap();
        assert!(is_locked(&path) && Lock::try_take(&path).unwrap().is_none());
    }

    #[test]
    fn a_lock_is_held_by_one_at_a_time() {
        let directory = tempfile::tempdir().unwrap();
        for path in [directory.path(), &directory.path().join("lock")] {
            let lock = Lock::try_take(path).unwrap();
            assert!(lock.is_some() && Lock::try_take(path).unwrap().is_none());
            drop(lock);
            assert!(Lock::try_take(path).unwrap().is_some());
        }
    }
}
