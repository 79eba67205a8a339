//! Operations that some file systems do not support. A missing operation is skipped, and its consequence is logged
//! once.

use std::fs::TryLockError;
use std::io::{Error, Result};
use std::path::Path;
use std::sync::atomic::{AtomicU8, Ordering};

use rustix::io::Errno;

/// The operations whose absence this process has logged, as bits.
static REPORTED: AtomicU8 = AtomicU8::new(0);

/// An operation that a file system may not support.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operation {
    /// An advisory lock. Lustre without `-o flock`, NFS without a lock daemon and some FUSE systems do not support it.
    Lock,
    /// Flushing a file, or the names in a folder, to the disk.
    Sync,
    /// Replacing a file by renaming another file. It is impossible if the file itself is a mount point.
    Rename,
}

impl Operation {
    /// Returns whether `error` means that the file system does not support the operation, rather than that the
    /// operation failed.
    fn is_missing(self, error: &Error) -> bool {
        let errno = Errno::from_io_error(error);
        let others: &[Errno] = match self {
            Self::Lock => &[Errno::NOLCK, Errno::BADF, Errno::INVAL],
            Self::Sync => &[Errno::INVAL, Errno::BADF],
            Self::Rename => &[Errno::PERM, Errno::XDEV, Errno::BUSY, Errno::EXIST],
        };
        errno.is_some_and(|errno| errno == Errno::NOSYS || errno == Errno::OPNOTSUPP || others.contains(&errno))
    }

    /// Describes the consequence of the missing operation, for the log.
    fn consequence(self) -> &'static str {
        match self {
            Self::Lock => {
                "it cannot lock files: nothing protects a run or a ledger from a second process that writes it; start \
                 each once"
            }
            Self::Sync => "it cannot write files through to the disk: a power failure may lose what was written last",
            Self::Rename => {
                "it cannot replace a file in one step: another program may read a half-written file, and a power \
                 failure may leave one"
            }
        }
    }
}

/// Converts the result of a locking attempt: whether the lock was taken, or `None` if the file system does not support
/// locks.
///
/// # Errors
/// The operating system's error.
pub fn is_acquired(lock: std::result::Result<(), TryLockError>, path: &Path) -> Result<Option<bool>> {
    let taken = match lock {
        Ok(()) => Ok(true),
        Err(TryLockError::WouldBlock) => Ok(false),
        Err(TryLockError::Error(source)) => Err(source),
    };
    unless_unsupported(Operation::Lock, taken, path)
}

/// Replaces the error of a file system that does not support `operation` by `None`, and logs the consequence once.
///
/// # Errors
/// All other errors.
pub fn unless_unsupported<T>(operation: Operation, result: Result<T>, path: &Path) -> Result<Option<T>> {
    match result {
        Err(error) if operation.is_missing(&error) => {
            let bit = 1 << operation as u8;
            if REPORTED.fetch_or(bit, Ordering::Relaxed) & bit == 0 {
                tracing::warn!("the file system of {}: {} ({error})", path.display(), operation.consequence());
            }
            Ok(None)
        }
        result => result.map(Some),
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[test]
    fn a_file_system_without_locks_is_told_from_a_taken_lock() {
        let refused = |code| Err(TryLockError::Error(Error::from_raw_os_error(code)));
        assert_eq!(is_acquired(refused(37), Path::new("lock")).unwrap(), None);
        assert!(is_acquired(refused(5), Path::new("lock")).is_err());
        let taken = [Ok(()), Err(TryLockError::WouldBlock)].map(|lock| is_acquired(lock, Path::new("lock")).unwrap());
        assert_eq!(taken, [Some(true), Some(false)]);
    }

    #[rstest]
    #[case::enosys(38, [true, true, true])]
    #[case::eopnotsupp(95, [true, true, true])]
    #[case::enolck(37, [true, false, false])]
    #[case::ebadf(9, [true, true, false])]
    #[case::einval(22, [true, true, false])]
    #[case::eperm(1, [false, false, true])]
    #[case::ebusy(16, [false, false, true])]
    #[case::eio(5, [false, false, false])]
    #[case::enospc(28, [false, false, false])]
    #[case::eacces(13, [false, false, false])]
    fn a_missing_operation_is_not_a_failed_one(#[case] code: i32, #[case] expected: [bool; 3]) {
        let is_missing = |operation: Operation| {
            let refused = Err::<(), _>(Error::from_raw_os_error(code));
            unless_unsupported(operation, refused, Path::new("file")).is_ok()
        };
        assert_eq!([Operation::Lock, Operation::Sync, Operation::Rename].map(is_missing), expected);
    }
}
