//! Priorities of threads. The transport comes before all others, at any niceness of the process.

use std::sync::OnceLock;

/// Raises this thread's niceness by `by` above the process's. If the system refuses, the thread keeps its niceness. The
/// first call in the process reads the process's niceness, so it must come from a thread that has not changed its own.
pub(crate) fn lower(by: i32) {
    static NICENESS: OnceLock<i32> = OnceLock::new();
    let niceness = *NICENESS.get_or_init(|| rustix::process::getpriority_process(None).unwrap_or(0));
    if let Err(error) = rustix::process::setpriority_process(None, niceness + by) {
        tracing::debug!(%error, "a thread keeps its priority");
    }
}
