//! How long a training has run, over all the processes that it ran in.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Seconds of training. Goes on after a break as if there had been none.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    t_start: f64,
    before: f64,
    since: Instant,
}

impl Clock {
    /// Begins at `elapsed` seconds, 0 for a new training, and now.
    pub fn start(elapsed: f64) -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        Self::new(now - elapsed, elapsed)
    }

    /// The same at another time of day: `t_start` is that at which the training began, or would have begun without a
    /// break, in seconds since 1970.
    pub fn new(t_start: f64, elapsed: f64) -> Self {
        Self { t_start, before: elapsed, since: Instant::now() }
    }

    /// Seconds of training so far.
    pub fn elapsed(&self) -> f64 {
        self.before + self.since.elapsed().as_secs_f64()
    }

    /// The time of day at second 0, in seconds since 1970.
    pub fn t_start(&self) -> f64 {
        self.t_start
    }
}
