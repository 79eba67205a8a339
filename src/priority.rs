//! The priority of threads: the transport comes first, whatever the process was started with.

use std::sync::OnceLock;

/// Sets this thread's niceness to so much above the process's. Where the system refuses, the thread takes turns with the
/// others. Of the first call it must be the thread's first, since that is where the process's is read.
pub(crate) fn lower(by: i32) {
    static NICENESS: OnceLock<i32> = OnceLock::new();
    let niceness = *NICENESS.get_or_init(|| rustix::process::getpriority_process(None).unwrap_or(0));
    if let Err(error) = rustix::process::setpriority_process(None, niceness + by) {
        tracing::debug!(%error, "a thread keeps its priority");
    }
}
