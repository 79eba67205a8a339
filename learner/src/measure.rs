//! Measures the time per step of a group of cells, for estimates of an experiment's duration.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::time::{Duration, Instant};

use perturb_experiment::scheduler::CellEvent;
use perturb_experiment::{Cell, ExperimentFolder, Measurement, Speed};
use perturb_files::interrupt::{Scratch, StopFlag};
use perturb_files::{FileError, io};

use crate::cell::{CellJob, run_cells};
use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::client::{Address, ClientError, Servers};
use crate::evaluation::{TestError, TestOptions, Tester};
use crate::training::{RunDirectory, RunDirectoryError, TrainError, train};

/// Episode budget of a measured training, so large that the training never ends by itself.
const UNLIMITED_EPISODES: u64 = 1 << 40;
/// Maximum number of reports by which another cell may be ahead of the leader, see [`SpeedMeter`]. If it is further
/// ahead, the leader counts as failed.
const MAX_MISSED_UPDATES: u64 = 100;
/// Number of test episodes. Each is played in a separate environment.
const TEST_EPISODES: u64 = 100;

/// The reason why a group could not be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeasureError {
    /// A temporary folder cannot be created.
    #[error(transparent)]
    File(#[from] FileError),
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The training of a cell failed or lost its server.
    #[error("measuring {id}: {reason}")]
    Ended {
        /// The id of the cell.
        id: String,
        /// The reason of the failure.
        reason: String,
    },
    /// The training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// A training cannot use its directory.
    #[error(transparent)]
    Directory(#[from] RunDirectoryError),
    /// The checkpoint of the measured training cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The test of the checkpoint failed.
    #[error(transparent)]
    Test(#[from] TestError),
    /// A signal asked the program to stop.
    #[error("stopped by signal {signal} while measuring; the measurement is discarded")]
    Stopped {
        /// The signal's number.
        signal: i32,
    },
}

/// Measures the time per step of training and of tests.
///
/// Trains the cells of `group` together, as an experiment does, for about `limit` and at least two iterations. `group`
/// must not be empty. Then tests one of the policies. Does this in `jobs` threads at the same time and averages the
/// results, because parallel jobs slow each other down. Deletes the policies at the end.
///
/// # Errors
/// [`MeasureError`] if a training or test fails, and [`MeasureError::Stopped`] soon after `stop` is raised.
pub fn measure(
    servers: &Servers,
    group: &[&Cell],
    jobs: usize,
    limit: Duration,
    stop: &StopFlag,
) -> Result<Measurement, MeasureError> {
    let addresses: Vec<Address> = servers.addresses();
    let one = |job| {
        let servers = Servers::connect_to_one(&addresses, job, stop)?;
        let scratch = Scratch::new().map_err(io("create a temporary folder (TMPDIR) in", &std::env::temp_dir()))?;
        let measured = measure_one(&servers, group, scratch.path(), limit, stop);
        stop.signal().map_or(measured, |signal| Err(MeasureError::Stopped { signal }))
    };
    let one = &one;
    let speeds: Vec<Speed> = std::thread::scope(|scope| {
        let spawn = |job| std::thread::Builder::new().spawn_scoped(scope, move || one(job));
        let system = |source| ClientError::System { action: "start a thread", source };
        let jobs = (0..jobs.max(1)).map(spawn).collect::<Result<Vec<_>, _>>().map_err(system)?;
        let joined = jobs.into_iter().map(|job| job.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        joined.collect::<Result<_, MeasureError>>()
    })?;
    let mean = |of: fn(&Speed) -> f64| speeds.iter().map(of).sum::<f64>() / speeds.len() as f64;
    Ok(Measurement {
        environment: group[0].config.common.environment.clone(),
        method: group[0].method(),
        cells: group.len(),
        speed: Speed { training: mean(|speed| speed.training), testing: mean(|speed| speed.testing) },
    })
}

/// Measures one job: trains the group in the folder `scratch`, then tests one policy. A policy that does not learn
/// is only tested.
fn measure_one(
    servers: &Servers,
    group: &[&Cell],
    scratch: &Path,
    limit: Duration,
    stop: &StopFlag,
) -> Result<Speed, MeasureError> {
    if !group[0].config.settings.learns() {
        let directory = RunDirectory::choose(scratch, true)?;
        let made = train(servers, &group[0].config, &directory, 1, &StopFlag::default(), |_| {})?;
        return Ok(Speed { training: 0.0, testing: measure_test(servers, group[0], &made.checkpoint, stop)? });
    }
    // Trains without a budget until the time limit, as an experiment trains its cells.
    let endless = |cell: &&Cell| {
        let mut cell = Cell::clone(cell);
        cell.config.common.episodes = UNLIMITED_EPISODES;
        cell
    };
    let cells: Vec<Cell> = group.iter().map(endless).collect();
    let folder = ExperimentFolder::new(scratch);
    let job = |cell| CellJob { cell, folder: folder.cell(&cell.id), retry: None };
    let jobs: Vec<CellJob<'_>> = cells.iter().map(job).collect();
    let enough = StopFlag::default();
    let mut meter = SpeedMeter::new();
    run_cells(servers, &jobs, &enough, &mut |cell, event| {
        if meter.on_event(&cell.id, event) >= limit || stop.signal().is_some() {
            enough.raise(1);
        }
    });
    let (trained, training) = meter.end()?;
    let cell = cells.iter().find(|cell| cell.id == trained).unwrap_or(&cells[0]);
    let checkpoint = Checkpoint::load(&folder.cell(&cell.id).training())?;
    Ok(Speed { training, testing: measure_test(servers, cell, &checkpoint, stop)? })
}

/// Measures the training speed of a group of cells from the cells' progress reports.
///
/// The leader is the cell that reports first. The meter takes the time from the leader's first to its last report, and
/// counts the steps of all cells in this time. The cells of a group update in turn, so each other cell has one update
/// between two reports of the leader.
struct SpeedMeter {
    start: Instant,
    timesteps: HashMap<String, u64>,
    /// Number of reports by cell id.
    reports: HashMap<String, u64>,
    leader: Option<String>,
    /// Time of the leader's first report, and the sum of all steps that were reported before it.
    first: Option<(Duration, u64)>,
    /// Time of the leader's last report, and the sum of all steps that were reported before it.
    last: Option<(Duration, u64)>,
    ended: Option<MeasureError>,
}

impl SpeedMeter {
    fn new() -> Self {
        let timesteps = HashMap::new();
        let reports = HashMap::new();
        Self { start: Instant::now(), timesteps, reports, leader: None, first: None, last: None, ended: None }
    }

    /// Processes an event of the cell `id`. Returns the time since the meter started, or zero before the leader's
    /// second report. If the leader has stopped reporting, this cell becomes the leader.
    fn on_event(&mut self, id: &str, event: CellEvent) -> Duration {
        let now = self.start.elapsed();
        match event {
            CellEvent::Training { timesteps, .. } if timesteps > 0 => {
                *self.reports.entry(id.to_owned()).or_default() += 1;
                let silent =
                    |leader: &String| self.reports[id] > self.reports.get(leader).unwrap_or(&0) + MAX_MISSED_UPDATES;
                if self.leader.as_ref().is_some_and(silent) {
                    (self.leader, self.first, self.last) = (None, None, None); // the leader has failed; its error is reported at the end
                }
                let leads = self.leader.get_or_insert_with(|| id.to_owned()) == id;
                // A training repeats its last report at its end. The repetition is ignored.
                if leads && self.timesteps.get(id).is_none_or(|&known| known < timesteps) {
                    let point = (now, self.timesteps.values().sum());
                    self.first.get_or_insert(point);
                    self.last = Some(point);
                }
                match self.timesteps.get_mut(id) {
                    Some(known) => *known = timesteps,
                    None => drop(self.timesteps.insert(id.to_owned(), timesteps)),
                }
            }
            CellEvent::Failed { reason } | CellEvent::LostServer { reason } | CellEvent::FileFault { reason } => {
                self.ended.get_or_insert(MeasureError::Ended { id: id.to_owned(), reason });
            }
            _ => {}
        }
        if self.first == self.last { Duration::ZERO } else { now }
    }

    /// Returns the id of the leader, and the seconds per step.
    fn end(self) -> Result<(String, f64), MeasureError> {
        let measured = self.leader.zip(self.first.zip(self.last));
        let seconds = measured.and_then(|(leader, ((begun, before), (ended, after)))| {
            (after > before).then(|| (leader, (ended - begun).as_secs_f64() / (after - before) as f64))
        });
        // The failure of a cell is an error only if no other cell was measured.
        seconds.ok_or_else(|| {
            let nothing = || MeasureError::Ended { id: "a group".into(), reason: "it has made no step".into() };
            self.ended.unwrap_or_else(nothing)
        })
    }
}

/// Returns the seconds per step in tests.
fn measure_test(servers: &Servers, cell: &Cell, checkpoint: &Checkpoint, stop: &StopFlag) -> Result<f64, MeasureError> {
    let episodes = cell.tests.episodes.min(TEST_EPISODES);
    let seed = cell.config.common.seed;
    let success = cell.tests.success.clone();
    let options = TestOptions { episodes, seed, selects: false, success };
    let sets = &cell.tests.sets[..1.min(cell.tests.sets.len())];
    let start = Instant::now();
    let records = Tester::new(servers, checkpoint, options)?.test(sets, stop, &mut |_, _| {})?;
    let seconds = start.elapsed().as_secs_f64();
    // Each environment plays one episode (or trial). All environments are stepped until the longest episode has ended,
    // so the number of steps is the longest length times the number of environments.
    let mut lengths: BTreeMap<u32, u64> = BTreeMap::new();
    for episode in &records.episodes {
        *lengths.entry(episode.environment_index).or_default() += u64::from(episode.length);
    }
    let longest = lengths.values().max().copied().unwrap_or_default();
    Ok(seconds / (longest * lengths.len() as u64).max(1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn training(timesteps: u64) -> CellEvent {
        CellEvent::Training { episodes: 1, timesteps, saved: 0 }
    }

    #[test]
    fn steps_count_between_two_iterations_of_the_first_cell() {
        let mut meter = SpeedMeter::new();
        for id in ["a", "b"] {
            assert_eq!(meter.on_event(id, training(0)), Duration::ZERO);
        }
        assert_eq!(meter.on_event("a", training(5)), Duration::ZERO);
        assert_eq!(meter.on_event("b", training(80)), Duration::ZERO);
        meter.start -= Duration::from_secs(7);
        assert!(meter.on_event("a", training(10)) >= Duration::from_secs(7));
        meter.on_event("b", training(160));
        meter.on_event("a", training(10));
        let ((_, before), (_, after)) = (meter.first.unwrap(), meter.last.unwrap());
        assert_eq!((before, after), (0, 85), "an iteration of both");
        let (leader, seconds) = meter.end().unwrap();
        assert!(leader == "a" && (seconds * 85.0 - 7.0).abs() < 0.5, "{seconds}");
    }

    #[test]
    fn failed_leader_is_replaced() {
        let mut meter = SpeedMeter::new();
        meter.on_event("a", training(5));
        for round in 1..=MAX_MISSED_UPDATES + 10 {
            meter.on_event("b", training(80 * round));
        }
        meter.on_event("a", CellEvent::Failed { reason: "NaN".into() });
        let (leader, seconds) = meter.end().unwrap();
        assert!(leader == "b" && seconds > 0.0);
    }

    #[test]
    fn failed_group_is_an_error() {
        let mut meter = SpeedMeter::new();
        meter.on_event("a", training(5));
        meter.on_event("a", CellEvent::Failed { reason: "NaN".into() });
        assert_eq!(meter.end().unwrap_err().to_string(), "measuring a: NaN");
        assert!(SpeedMeter::new().end().unwrap_err().to_string().contains("it has made no step"));
    }
}
