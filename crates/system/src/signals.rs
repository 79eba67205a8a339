//! Signals that must not end a program.

use std::io::Result;

use rustix::process::Signal;
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

/// Lets a write beyond the process's limit of file sizes (`ulimit -f`) fail with EFBIG. Without this call, SIGXFSZ would
/// end the program without a message. Call it first in `main`, and again in a program that replaces this one.
///
/// # Errors
/// The operating system's. The program may continue: only that limit then ends it.
pub fn ignore_sigxfsz() -> Result<()> {
    // A handler that does nothing has the same effect as ignoring. tokio keeps the handler after the runtime's end.
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let _entered = runtime.enter();
    signal(SignalKind::from_raw(Signal::XFSZ.as_raw())).map(drop)
}
