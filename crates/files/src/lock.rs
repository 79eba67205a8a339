//! Locks that protect folders from other processes.

use std::fs::{File, TryLockError};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use perturb_system::plain::nonblocking_flag;
use perturb_system::support::is_acquired;

use super::{Result, io};

/// The name of the file that is locked in place of its folder, because NFS on Linux cannot lock a folder.
const LOCK_FILE: &str = "lock";
/// Maximum number of attempts to take a lock that another process is only testing.
const MAX_LOCK_TRIES: u32 = 100;
/// Time between two attempts to take a lock. Another process's test of the lock takes some microseconds.
const LOCK_RETRY_INTERVAL: Duration = Duration::from_millis(1);

/// An advisory lock of a folder. The operating system releases it when the process ends for any reason.
#[derive(Debug)]
pub struct Lock(File);

impl Drop for Lock {
    /// Unlocks explicitly before the file is closed. Closing may not be enough: a child process that is just being
    /// started briefly has copies of all open files.
    fn drop(&mut self) {
        let _ = self.0.unlock(); // if this fails, closing the file releases the lock
    }
}

impl Lock {
    /// Takes the lock of `folder`. Creates the file `lock` in the folder if it is missing. Returns `None` if another
    /// process has the lock; a process that only [tests the lock](is_locked) does not count. On a file system without
    /// locks, every process gets the lock, and a warning is logged once.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn try_take(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(LOCK_FILE);
        // NFS requires read permission for a shared lock and write permission for an exclusive lock.
        let mut options = File::options();
        options.create(true).truncate(false).read(true).write(true).custom_flags(nonblocking_flag());
        let file = options.open(&path).map_err(io("open", &path))?;
        for _ in 0..MAX_LOCK_TRIES {
            let exclusive = is_acquired(file.try_lock(), &path).map_err(io("lock", &path))?;
            if exclusive != Some(false) {
                return Ok(Some(Self(file)));
            }
            // A process that holds the lock has it exclusively, while a test uses a shared lock. If this process can
            // get a shared lock, no process holds the lock, and another process is only testing it.
            match is_acquired(file.try_lock_shared(), &path).map_err(io("lock", &path))? {
                Some(true) => file.unlock().map_err(io("unlock", &path))?,
                _ => return Ok(None),
            }
            std::thread::sleep(LOCK_RETRY_INTERVAL);
        }
        Ok(None)
    }

    /// Returns whether `folder` was ever locked: whether it contains the file `lock`.
    pub fn is_there(folder: &Path) -> bool {
        folder.join(LOCK_FILE).exists()
    }
}

/// Returns whether a process holds the lock of `folder`. The test takes a shared lock for a moment, for which
/// [`Lock::try_take`] waits.
pub fn is_locked(folder: &Path) -> bool {
    let file = File::options().read(true).custom_flags(nonblocking_flag()).open(folder.join(LOCK_FILE));
    file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lock_ends_with_its_value_despite_inherited_files() {
        let directory = tempfile::tempdir().unwrap();
        let lock = Lock::try_take(directory.path()).unwrap().unwrap();
        let copy = lock.0.try_clone().unwrap(); // a child process that is just being started has such a copy
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
