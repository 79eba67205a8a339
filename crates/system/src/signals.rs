//! Keeps the signal SIGXFSZ from ending a program.

use std::io::Result;

use rustix::process::Signal;
use tokio::runtime::Builder;
use tokio::signal::unix::{SignalKind, signal};

/// Makes a write beyond the limit of file sizes (`ulimit -f`) fail with the error EFBIG. Without this call, the signal
/// SIGXFSZ would end the program without a message. Call it first in `main`. A program that replaces this one by `exec`
/// must call it again.
///
/// # Errors
/// Errors of the operating system. The program may continue, but then reaching the limit ends it.
pub fn ignore_sigxfsz() -> Result<()> {
    // A handler that does nothing has the same effect as ignoring the signal. tokio never removes its handlers.
    let runtime = Builder::new_current_thread().enable_io().build()?;
    let _entered = runtime.enter();
    signal(SignalKind::from_raw(Signal::XFSZ.as_raw())).map(drop)
}
