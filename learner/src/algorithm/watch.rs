//! Interrupts a long update when a signal asks the program to stop.

use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;

use crate::error::{Error, Result};

/// Maximum time that the rest of an update may take after a signal. A longer update is interrupted. The training can
/// then be resumed from its last checkpoint, with the same bytes as without the interruption.
const MAX_REMAINING: Duration = Duration::from_secs(5);

/// Counts the gradient steps of an update and estimates the time of the remaining ones.
pub(super) struct UpdateWatch {
    stop: StopFlag,
    begun: Instant,
    done: usize,
    total: usize,
}

impl UpdateWatch {
    /// Starts the clock for an update of `total` gradient steps.
    pub(super) fn new(stop: &StopFlag, total: usize) -> Self {
        Self { stop: stop.clone(), begun: Instant::now(), done: 0, total }
    }

    /// Counts one finished gradient step.
    ///
    /// # Errors
    /// [`Error::Stopped`] if the stop flag is raised and the rest of the update would take longer than
    /// [`MAX_REMAINING`].
    pub(super) fn step(&mut self) -> Result<()> {
        self.done += 1;
        let Some(signal) = self.stop.signal() else { return Ok(()) };
        let seconds_per_step = self.begun.elapsed().as_secs_f64() / self.done as f64;
        let remaining = seconds_per_step * self.total.saturating_sub(self.done) as f64;
        if remaining > MAX_REMAINING.as_secs_f64() { Err(Error::Stopped { signal }) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_update_is_broken_off_and_a_short_one_finished() {
        let stop = StopFlag::default();
        let watch = |total| UpdateWatch {
            stop: stop.clone(),
            begun: Instant::now().checked_sub(Duration::from_secs(1)).unwrap(),
            done: 9,
            total,
        };
        assert!(watch(1_000_000).step().is_ok(), "nobody asked for an end");
        stop.raise(15);
        assert!(watch(20).step().is_ok(), "a second is left");
        assert!(matches!(watch(1000).step(), Err(Error::Stopped { signal: 15 })));
    }
}
