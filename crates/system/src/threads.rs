//! Explains why the operating system cannot start a thread.

use std::io::Error;

use rustix::process::{Resource, getrlimit};

/// Explains why a thread or process could not be started. Returns `error` with the limits that the user or a container
/// may have reached.
pub fn explain_no_thread(error: &Error) -> Error {
    let limit = getrlimit(Resource::Nproc).current.map_or_else(|| "unlimited".into(), |limit| limit.to_string());
    let words = format!(
        "the system cannot start another thread or process ({error}): this user may have {limit} of them in all \
         (`ulimit -u`, RLIMIT_NPROC), and a container as many as its pids.max; raise the limit, or end other programs"
    );
    Error::new(error.kind(), words)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_of_threads_is_named() {
        let error = explain_no_thread(&Error::from_raw_os_error(11));
        let words = error.to_string();
        assert!(words.contains("ulimit -u") && words.contains("os error 11"), "{words}");
        assert_eq!(error.kind(), std::io::ErrorKind::WouldBlock);
    }
}
