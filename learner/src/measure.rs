//! Measuring what a cell's steps cost.

use std::time::{Duration, Instant};

use perturb_study::files::io;
use perturb_study::interrupt::StopFlag;
use perturb_study::{Cell, Measurement, Speed};

use crate::client::Servers;
use crate::training::{RunDirectory, TrainError, train};

/// Trains as `cell` does for about `limit`, at least one iteration, and forgets what was learned.
///
/// # Errors
/// [`TrainError`].
pub fn measure(servers: &Servers, cell: &Cell, limit: Duration) -> Result<Measurement, TrainError> {
    let scratch = tempfile::tempdir().map_err(io("create a folder in", &std::env::temp_dir()))?;
    let directory = RunDirectory::choose(scratch.path(), true)?;
    let stop = StopFlag::default();
    let start = Instant::now();
    let mut first = None;
    let outcome = train(servers, &cell.config, &directory, 1, &stop, |progress| {
        first.get_or_insert(*progress);
        if start.elapsed() >= limit {
            stop.raise(1);
        }
    })?;
    let last = outcome.progress;
    // The first iteration has what happens once; if there is no other, it has to do.
    let before = first.filter(|first| first.timesteps < last.timesteps);
    let since = |before: Option<f64>, last: f64| last - before.unwrap_or(0.0);
    let steps = since(before.map(|first| first.timesteps as f64), last.timesteps as f64);
    let seconds = since(before.map(|first| first.elapsed), last.elapsed);
    let updating = since(before.map(|first| first.shares.updating), last.shares.updating);
    let speed = Speed { training: seconds / steps, testing: (seconds - updating).max(0.0) / steps };
    Ok(Measurement { environment: cell.config.common.environment.clone(), method: cell.method(), speed })
}
