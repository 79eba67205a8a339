//! Priorities of threads. The transport threads have a higher priority than all others.

use std::sync::OnceLock;

/// Lowers the priority of the calling thread: sets its niceness to the process's niceness plus `by`. If the system
/// refuses, the priority stays, and the refusal is logged. The first call in the process reads the process's niceness,
/// so it must come from a thread whose niceness has not been changed.
pub(crate) fn lower(by: i32) {
    static NICENESS: OnceLock<i32> = OnceLock::new();
    let niceness = *NICENESS.get_or_init(|| rustix::process::getpriority_process(None).unwrap_or(0));
    if let Err(error) = rustix::process::setpriority_process(None, niceness + by) {
        tracing::debug!(%error, "a thread keeps its priority");
    }
}
