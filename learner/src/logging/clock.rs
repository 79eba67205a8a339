//! Counts the seconds of a training over all processes that take part in it.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Counts seconds of training. Time between an interruption and the resumption does not count.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    t_start: f64,
    before: f64,
    since: Instant,
}

impl Clock {
    /// Starts the clock now, with `elapsed` seconds of earlier training: 0 for a new training.
    pub fn start(elapsed: f64) -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        Self::new(now - elapsed, elapsed)
    }

    /// Starts the clock now, with `elapsed` seconds of earlier training. `t_start` is the time at which the
    /// training would have started without interruptions, in seconds since 1970.
    pub fn new(t_start: f64, elapsed: f64) -> Self {
        Self { t_start, before: elapsed, since: Instant::now() }
    }

    /// Returns the seconds of training so far.
    pub fn elapsed(&self) -> f64 {
        self.before + self.since.elapsed().as_secs_f64()
    }

    /// Returns the time at which the training would have started without interruptions, in seconds since 1970.
    pub fn t_start(&self) -> f64 {
        self.t_start
    }
}
