//! Measuring what the steps of a group of cells cost.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::time::{Duration, Instant};

use perturb_experiment::scheduler::CellEvent;
use perturb_experiment::{Cell, Folder, Measurement, Speed};
use perturb_files::interrupt::{Scratch, StopFlag};
use perturb_files::{FileError, io};

use crate::cell::{CellOrder, run_cells};
use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::client::{Address, ClientError, Servers};
use crate::evaluation::{TestError, TestOptions, Tester};
use crate::training::{RunDirectory, RunDirectoryError, TrainError, train};

/// A budget that no measurement uses up.
const ENDLESS: u64 = 1 << 40;
/// A cell that is not heard of while another is so often has failed.
const SILENCE: u64 = 100;
/// Test episodes: one in each of so many environments.
const TEST_EPISODES: u64 = 100;

/// Why a group could not be measured.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeasureError {
    /// There is no place for what is written meanwhile.
    #[error(transparent)]
    File(#[from] FileError),
    /// There is no server.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// A training ended by itself.
    #[error("measuring {id}: {reason}")]
    Ended {
        /// The cell.
        id: String,
        /// How.
        reason: String,
    },
    /// A policy cannot be made.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// There is no place for it.
    #[error(transparent)]
    Directory(#[from] RunDirectoryError),
    /// What was learned cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// What was learned cannot be tested.
    #[error(transparent)]
    Test(#[from] TestError),
    /// The program was asked to end.
    #[error("stopped by signal {signal} while measuring; nothing is kept of it")]
    Stopped {
        /// The signal.
        signal: i32,
    },
}

/// Trains the cells of `group`, at least one, as a run would do them together, `jobs` times at once, for about `limit`,
/// at least two iterations; then tests one. Forgets what was learned.
///
/// # Errors
/// [`MeasureError`]; [`MeasureError::Stopped`] soon after `stop` is raised.
pub fn measure(
    servers: &Servers,
    group: &[&Cell],
    jobs: usize,
    limit: Duration,
    stop: &StopFlag,
) -> Result<Measurement, MeasureError> {
    let addresses: Vec<Address> = servers.addresses();
    let one = |job| {
        let servers = Servers::connect_to_one(&addresses, job)?;
        let scratch = Scratch::new().map_err(io("create a folder in", &std::env::temp_dir()))?;
        let measured = measure_one(&servers, group, scratch.path(), limit, stop);
        stop.signal().map_or(measured, |signal| Err(MeasureError::Stopped { signal }))
    };
    let one = &one;
    let speeds: Vec<Speed> = std::thread::scope(|scope| {
        let jobs: Vec<_> = (0..jobs.max(1)).map(|job| scope.spawn(move || one(job))).collect();
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

fn measure_one(
    servers: &Servers,
    group: &[&Cell],
    scratch: &Path,
    limit: Duration,
    stop: &StopFlag,
) -> Result<Speed, MeasureError> {
    if group[0].config.settings.is_random() {
        let directory = RunDirectory::choose(scratch, true)?;
        let made = train(servers, &group[0].config, &directory, 1, &StopFlag::default(), |_| {})?;
        return Ok(Speed { training: 0.0, testing: measure_test(servers, group[0], &made.checkpoint, stop)? });
    }
    let endless = |cell: &&Cell| {
        let mut cell = Cell::clone(cell);
        cell.config.common.episodes = ENDLESS;
        cell
    };
    let cells: Vec<Cell> = group.iter().map(endless).collect();
    let folder = Folder::new(scratch);
    let order = |cell| CellOrder { cell, folder: folder.cell(&cell.id), retry: None };
    let orders: Vec<CellOrder<'_>> = cells.iter().map(order).collect();
    let enough = StopFlag::default();
    let mut meter = Meter::new();
    run_cells(servers, &orders, &enough, &mut |cell, event| {
        if meter.hear(&cell.id, event) >= limit || stop.signal().is_some() {
            enough.raise(1);
        }
    });
    let (trained, training) = meter.end()?;
    let cell = cells.iter().find(|cell| cell.id == trained).unwrap_or(&cells[0]);
    let checkpoint = Checkpoint::load(&folder.cell(&cell.id).training())?;
    Ok(Speed { training, testing: measure_test(servers, cell, &checkpoint, stop)? })
}

/// The time from one iteration to another of the cell that is heard of first, and all steps of all cells between: where
/// cells take turns, between two of its iterations all others have had one.
struct Meter {
    start: Instant,
    timesteps: HashMap<String, u64>,
    /// How often something was heard of each.
    heard: HashMap<String, u64>,
    leader: Option<String>,
    /// When the leader's first and last iterations were told, and how many steps had been told before.
    first: Option<(Duration, u64)>,
    last: Option<(Duration, u64)>,
    ended: Option<MeasureError>,
}

impl Meter {
    fn new() -> Self {
        let timesteps = HashMap::new();
        let heard = HashMap::new();
        Self { start: Instant::now(), timesteps, heard, leader: None, first: None, last: None, ended: None }
    }

    /// Takes note of an event, and says for how long it has measured; zero until there is something to go by.
    fn hear(&mut self, id: &str, event: CellEvent) -> Duration {
        let now = self.start.elapsed();
        match event {
            CellEvent::Training { timesteps, .. } if timesteps > 0 => {
                *self.heard.entry(id.to_owned()).or_default() += 1;
                let silent = |leader: &String| self.heard[id] > self.heard.get(leader).unwrap_or(&0) + SILENCE;
                if self.leader.as_ref().is_some_and(silent) {
                    (self.leader, self.first, self.last) = (None, None, None); // it has failed, and says so at the end
                }
                let leads = self.leader.get_or_insert_with(|| id.to_owned()) == id;
                // Told again at the end, with nothing new.
                if leads && self.timesteps.get(id).is_none_or(|&known| known < timesteps) {
                    let told = (now, self.timesteps.values().sum());
                    self.first.get_or_insert(told);
                    self.last = Some(told);
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

    /// The leader, and the seconds of a step.
    fn end(self) -> Result<(String, f64), MeasureError> {
        let measured = self.leader.zip(self.first.zip(self.last));
        let seconds = measured.and_then(|(leader, ((begun, before), (ended, after)))| {
            (after > before).then(|| (leader, (ended - begun).as_secs_f64() / (after - before) as f64))
        });
        // One that failed is no reason to know nothing, if others were measured.
        seconds.ok_or_else(|| {
            let nothing = || MeasureError::Ended { id: "a group".into(), reason: "it has made no step".into() };
            self.ended.unwrap_or_else(nothing)
        })
    }
}

/// The seconds of a step in tests: they go on in all environments until the last has had its episode.
fn measure_test(servers: &Servers, cell: &Cell, checkpoint: &Checkpoint, stop: &StopFlag) -> Result<f64, MeasureError> {
    let episodes = cell.tests.episodes.min(TEST_EPISODES);
    let (seed, success) = (cell.config.common.seed, cell.tests.success.clone());
    let options = TestOptions { episodes, seed, selects: false, success };
    let sets = &cell.tests.sets[..1.min(cell.tests.sets.len())];
    let start = Instant::now();
    let records = Tester::new(servers, checkpoint, options)?.test(sets, stop, &mut |_, _| {})?;
    let seconds = start.elapsed().as_secs_f64();
    // Each environment plays one episode, or trial, and all go on until the longest has ended.
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
        let mut meter = Meter::new();
        for id in ["a", "b"] {
            assert_eq!(meter.hear(id, training(0)), Duration::ZERO);
        }
        assert_eq!(meter.hear("a", training(5)), Duration::ZERO);
        assert_eq!(meter.hear("b", training(80)), Duration::ZERO);
        meter.start -= Duration::from_secs(7);
        assert!(meter.hear("a", training(10)) >= Duration::from_secs(7));
        meter.hear("b", training(160));
        meter.hear("a", training(10));
        let ((_, before), (_, after)) = (meter.first.unwrap(), meter.last.unwrap());
        assert_eq!((before, after), (0, 85), "an iteration of both");
        let (leader, seconds) = meter.end().unwrap();
        assert!(leader == "a" && (seconds * 85.0 - 7.0).abs() < 0.5, "{seconds}");
    }

    #[test]
    fn one_that_fails_leaves_the_measurement_to_the_others() {
        let mut meter = Meter::new();
        meter.hear("a", training(5));
        for round in 1..=SILENCE + 10 {
            meter.hear("b", training(80 * round));
        }
        meter.hear("a", CellEvent::Failed { reason: "NaN".into() });
        let (leader, seconds) = meter.end().unwrap();
        assert!(leader == "b" && seconds > 0.0);
    }

    #[test]
    fn what_ends_by_itself_cannot_be_measured() {
        let mut meter = Meter::new();
        meter.hear("a", training(5));
        meter.hear("a", CellEvent::Failed { reason: "NaN".into() });
        assert_eq!(meter.end().unwrap_err().to_string(), "measuring a: NaN");
        assert!(Meter::new().end().unwrap_err().to_string().contains("it has made no step"));
    }
}
