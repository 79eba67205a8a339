//! Signals as a flag that loops can poll, and temporary folders that are deleted when a signal ends the program.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::task::Poll;
use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::Notify;

/// The folders of all existing [`Scratch`] values.
static SCRATCH: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());
/// The signal SIGXCPU, with which the kernel warns a process every second that its CPU time is used up.
const SIGXCPU: i32 = 24;

/// A flag that is raised when the program is asked to end.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<Raised>);

#[derive(Debug, Default)]
struct Raised {
    /// The number of the first signal, or 0 before any.
    signal: AtomicI32,
    since: OnceLock<Instant>,
    notify: Notify,
}

impl StopFlag {
    /// Returns a flag that the signals INT, TERM, HUP, USR1, USR2 and XCPU raise. A second INT or TERM ends the program
    /// immediately. The other signals may arrive repeatedly, from terminals, batch systems and the kernel. If the
    /// program was started with one of these other signals ignored, as `nohup` does with HUP, it still ignores this
    /// signal.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn on_signals() -> std::io::Result<Self> {
        let flag = Self::default();
        let raised = flag.clone();
        let ignored = ignored_signals();
        let warnings = [SignalKind::hangup(), SignalKind::user_defined1(), SignalKind::user_defined2()];
        let warnings = warnings.into_iter().chain([SignalKind::from_raw(SIGXCPU)]);
        let kinds: Vec<SignalKind> =
            ENDING.into_iter().chain(warnings.filter(|kind| !contains(ignored, kind.as_raw_value()))).collect();
        let mut was_ended = false;
        watch(&kinds, move |number| {
            if ENDING.iter().any(|kind| kind.as_raw_value() == number) && std::mem::replace(&mut was_ended, true) {
                end(number);
            }
            raised.raise(number);
        })?;
        Ok(flag)
    }

    /// Returns the number of the first signal, or `None` before any.
    pub fn signal(&self) -> Option<i32> {
        Some(self.0.signal.load(Ordering::SeqCst)).filter(|&number| number != 0)
    }

    /// Raises the flag as if signal `number` had arrived.
    pub fn raise(&self, number: i32) {
        let _ = self.0.since.set(Instant::now()); // only the first time is kept
        let _ = self.0.signal.compare_exchange(0, number, Ordering::SeqCst, Ordering::SeqCst);
        self.0.notify.notify_waiters();
    }

    /// Returns the time since the flag was raised, or `None` if it is not raised.
    pub fn elapsed(&self) -> Option<Duration> {
        self.0.since.get().map(Instant::elapsed)
    }

    /// Waits until the flag is raised, and returns the number of the signal.
    pub async fn raised(&self) -> i32 {
        loop {
            let notified = self.0.notify.notified();
            match self.signal() {
                Some(number) => return number,
                None => notified.await,
            }
        }
    }
}

/// The signals with which users and systems ask a program to end.
const ENDING: [SignalKind; 2] = [SignalKind::interrupt(), SignalKind::terminate()];

/// Makes SIGINT and SIGTERM end the program immediately. Use it in programs that have no work to complete at the end.
///
/// # Errors
/// An error of the operating system.
pub fn end_on_signals() -> std::io::Result<()> {
    watch(&ENDING, |number| {
        let _ = writeln!(std::io::stderr(), "stopped by signal {number}"); // the terminal may be gone
        end(number);
    })
}

/// Calls `hear` from a new thread with the number of each arriving signal of these `kinds`.
fn watch(kinds: &[SignalKind], mut hear: impl FnMut(i32) + Send + 'static) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let mut signals = {
        let _guard = runtime.enter();
        let listen = |&kind| Ok((SignalKind::as_raw_value(&kind), signal(kind)?));
        kinds.iter().map(listen).collect::<std::io::Result<Vec<(i32, Signal)>>>()?
    };
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        runtime.block_on(async move {
            loop {
                let next = std::future::poll_fn(|context| {
                    let came = signals
                        .iter_mut()
                        .find_map(|(number, signal)| signal.poll_recv(context).is_ready().then_some(*number));
                    came.map_or(Poll::Pending, Poll::Ready)
                });
                hear(next.await);
            }
        });
    })?;
    Ok(())
}

/// Returns the signals that this process was started to ignore, as a mask whose lowest bit is signal 1.
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or_default()
}

fn contains(mask: u64, signal: i32) -> bool {
    mask >> (signal - 1) & 1 == 1
}

/// Deletes all temporary folders and ends the program with the exit status that shells use for signal `number`.
fn end(number: i32) -> ! {
    for folder in scratch().iter() {
        let _ = std::fs::remove_dir_all(folder); // the program ends anyway
    }
    std::process::exit(128 + number);
}

/// A temporary folder that is deleted when this value is dropped, or when [`StopFlag`] or [`end_on_signals`] ends the
/// program.
#[derive(Debug)]
pub struct Scratch(PathBuf);

impl Scratch {
    /// Creates a new temporary folder.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn new() -> std::io::Result<Self> {
        let mut known = scratch(); // held until the folder is registered, so that a signal cannot leave it behind
        let folder = tempfile::Builder::new().prefix("perturb-").tempdir()?.keep();
        known.push(folder.clone());
        Ok(Self(folder))
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let mut known = scratch();
        let _ = std::fs::remove_dir_all(&self.0); // remaining files in a temporary folder do no harm
        known.retain(|folder| *folder != self.0);
    }
}

fn scratch() -> std::sync::MutexGuard<'static, Vec<PathBuf>> {
    SCRATCH.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_signal_is_kept_and_wakes_who_waits() {
        let flag = StopFlag::default();
        assert_eq!((flag.signal(), flag.elapsed()), (None, None));
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let other = flag.clone();
        let thread = std::thread::spawn(move || {
            other.raise(15);
            other.raise(2);
        });
        assert_eq!(runtime.block_on(flag.raised()), 15);
        thread.join().unwrap();
        assert!(flag.signal() == Some(15) && flag.elapsed().is_some());
    }

    #[test]
    fn masks_of_signals_count_from_one() {
        assert_eq!([1, 2, 24].map(|signal| contains(0x80_0001, signal)), [true, false, true]);
    }

    #[test]
    fn a_scratch_folder_is_known_while_it_is_there() {
        let folder = Scratch::new().unwrap();
        let path = folder.path().to_owned();
        std::fs::write(path.join("file"), "x").unwrap();
        assert!(scratch().contains(&path));
        drop(folder);
        assert!(!path.exists() && !scratch().contains(&path));
    }
}
