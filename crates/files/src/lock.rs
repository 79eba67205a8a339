//! Locks of folders against other processes.

use std::fs::{File, TryLockError};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use perturb_system::plain::nonblocking_flag;

use super::support::{Operation, unless_unsupported};
use super::{Result, io};

/// The file in a folder that is locked. Linux's NFS client cannot lock a folder itself.
const LOCK_FILE: &str = "lock";
/// Attempts to take a lock while another process only tests it.
const MAX_LOCK_TRIES: u32 = 100;
/// Time between two of these attempts. A test takes some microseconds.
const LOCK_RETRY_INTERVAL: Duration = Duration::from_millis(1);

/// An advisory lock: it ends with the process that holds it, however it ends.
#[derive(Debug)]
pub struct Lock(File);

impl Drop for Lock {
    /// Unlocks before the file is closed. A process that is just being started has copies of all open files for a moment,
    /// so closing alone would not unlock.
    fn drop(&mut self) {
        let _ = self.0.unlock(); // after a failure the closing unlocks
    }
}

impl Lock {
    /// Takes the lock of `folder`: its file `lock`, which is created if it is missing. Returns `None` while another process
    /// has the lock. A process that only [tests the lock](is_locked) does not have it. On a file system without locks every
    /// process gets the lock, and a warning says so once.
    ///
    /// # Errors
    /// The operating system's.
    pub fn try_take(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(LOCK_FILE);
        // NFS needs both permissions: reading for a shared lock, writing for an exclusive one.
        let mut options = File::options();
        options.create(true).truncate(false).read(true).write(true).custom_flags(nonblocking_flag());
        let file = options.open(&path).map_err(io("open", &path))?;
        for _ in 0..MAX_LOCK_TRIES {
            let exclusive = supported(file.try_lock(), &path).map_err(io("lock", &path))?;
            if exclusive != Some(false) {
                return Ok(Some(Self(file)));
            }
            // A taken lock is exclusive, a test of it is shared. If a shared lock is possible, another process only tests.
            match supported(file.try_lock_shared(), &path).map_err(io("lock", &path))? {
                Some(true) => file.unlock().map_err(io("unlock", &path))?,
                _ => return Ok(None),
            }
            std::thread::sleep(LOCK_RETRY_INTERVAL);
        }
        Ok(None)
    }

    /// Whether `folder` was locked before: it has the file that is locked.
    pub fn is_there(folder: &Path) -> bool {
        folder.join(LOCK_FILE).exists()
    }
}

/// Whether a process has the lock of `folder`. Takes a shared lock for a moment, for which [`Lock::try_take`] waits.
pub fn is_locked(folder: &Path) -> bool {
    let file = File::options().read(true).custom_flags(nonblocking_flag()).open(folder.join(LOCK_FILE));
    file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

/// Whether a lock was taken; `None` if the file system has no locks.
fn supported(taken: std::result::Result<(), TryLockError>, path: &Path) -> std::io::Result<Option<bool>> {
    let taken = match taken {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(source)) => Err(source),
    };
    unless_unsupported(Operation::Lock, taken, path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_system_without_locks_gives_the_lock() {
        let refused = Err(TryLockError::Error(std::io::Error::from_raw_os_error(37)));
        assert_eq!(supported(refused, Path::new("lock")).unwrap(), None);
        let broken = Err(TryLockError::Error(std::io::Error::from_raw_os_error(5)));
        assert!(supported(broken, Path::new("lock")).is_err());
    }

    #[test]
    fn lock_ends_with_its_value_despite_inherited_files() {
        let directory = tempfile::tempdir().unwrap();
        let lock = Lock::try_take(directory.path()).unwrap().unwrap();
        let copy = lock.0.try_clone().unwrap(); // a process that is being started gets such a copy
        assert!(Lock::try_take(directory.path()).unwrap().is_none());
        drop(lock);
        assert!(Lock::try_take(directory.path()).unwrap().is_some());
        drop(copy);
    }

    #[test]
    fn a_lock_is_had_while_others_look_whether_it_is_taken() {
        let directory = tempfile::tempdir().unwrap();
        let folder = directory.path();
        drop(Lock::try_take(folder).unwrap());
        let looks = File::open(folder.join(LOCK_FILE)).unwrap();
        looks.lock_shared().unwrap();
        let begun = std::time::Instant::now();
        assert!(Lock::try_take(folder).unwrap().is_none(), "who looks for ever");
        assert!(begun.elapsed() >= MAX_LOCK_TRIES * LOCK_RETRY_INTERVAL, "was waited for");
        looks.unlock().unwrap();
        let _lock = Lock::try_take(folder).unwrap().unwrap();
        assert!(is_locked(folder) && Lock::try_take(folder).unwrap().is_none());
    }

    #[test]
    fn a_lock_is_held_by_one_at_a_time() {
        let directory = tempfile::tempdir().unwrap();
        assert!(!Lock::is_there(directory.path()) && !is_locked(directory.path()));
        let lock = Lock::try_take(directory.path()).unwrap();
        assert!(lock.is_some() && Lock::try_take(directory.path()).unwrap().is_none());
        drop(lock);
        assert!(Lock::is_there(directory.path()) && !is_locked(directory.path()));
        assert!(Lock::try_take(directory.path()).unwrap().is_some());
    }

    #[test]
    fn a_pipe_in_place_of_the_lock_is_not_waited_for() {
        let directory = tempfile::tempdir().unwrap();
        let pipe = directory.path().join(LOCK_FILE);
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        assert!(!is_locked(directory.path()));
    }
}
