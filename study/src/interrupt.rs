//! Ctrl-C and SIGTERM as a flag that loops look at.

use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};

use tokio::signal::unix::{SignalKind, signal};

/// Raised when the program is asked to end.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicI32>);

impl StopFlag {
    /// A flag that SIGINT and SIGTERM raise. The first one asks, the second one ends the program at once.
    ///
    /// # Errors
    /// The operating system's.
    pub fn on_signals() -> std::io::Result<Self> {
        let flag = Self::default();
        let raised = flag.clone();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (mut interrupt, mut terminate) = {
            let _guard = runtime.enter();
            (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
        };
        std::thread::Builder::new().name("signals".into()).spawn(move || {
            runtime.block_on(async move {
                loop {
                    let number = tokio::select! {
                        Some(()) = interrupt.recv() => SignalKind::interrupt().as_raw_value(),
                        Some(()) = terminate.recv() => SignalKind::terminate().as_raw_value(),
                        else => return,
                    };
                    if raised.0.swap(number, Ordering::SeqCst) != 0 {
                        std::process::exit(128 + number);
                    }
                }
            });
        })?;
        Ok(flag)
    }

    /// The number of the signal that was received; `None` so far.
    pub fn signal(&self) -> Option<i32> {
        Some(self.0.load(Ordering::SeqCst)).filter(|&number| number != 0)
    }

    /// Raises it, as signal `number` would.
    pub fn raise(&self, number: i32) {
        self.0.store(number, Ordering::SeqCst);
    }
}
