//! Doing cells: train, test, write the result.

mod result;

use std::path::Path;
use std::time::Instant;

use perturb_checkpoint::Counters;
use perturb_experiment::scheduler::CellEvent;
use perturb_experiment::{Cell, CellFolder, CellState, Failure, FailureMark, FolderError, Timing};
use perturb_files::Lock;
use perturb_files::interrupt::StopFlag;
use perturb_records::RecordsError;

use crate::checkpoint::{Checkpoint, ResumeState};
use crate::client::Servers;
use crate::evaluation::TestError;
use crate::logging::Progress;
use crate::training::{Entry, Outcome, RunDirectory, RunDirectoryError, Start, TrainError, is_over, train_together};

/// What a stop without a signal counts as.
const SIGTERM: i32 = 15;

/// Why a cell has no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CellError {
    /// It cannot be trained.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// It cannot be tested.
    #[error(transparent)]
    Test(#[from] TestError),
    /// Its episodes cannot be recorded.
    #[error(transparent)]
    Records(#[from] RecordsError),
}

impl CellError {
    /// Whose fault it is.
    fn fault(&self) -> Fault {
        match self {
            Self::Train(error) if error.is_for_want_of_room() => Fault::Room,
            Self::Train(error) if error.can_be_retried() => Fault::Server,
            Self::Test(error) if error.can_be_retried() => Fault::Server,
            Self::Train(error) if error.is_file_fault() => Fault::Files,
            Self::Records(RecordsError::File(error)) if error.is_fault() => Fault::Files,
            Self::Train(error) if error.must_begin_anew() => Fault::Training,
            Self::Test(TestError::Numbers(_)) => Fault::Training,
            _ => Fault::Other,
        }
    }
}

/// Whose fault it is that a cell has no result, which decides whether it may have one later.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// That of the servers or of the way to them.
    Server,
    /// The same: the server has no room for so many environments.
    Room,
    /// That of the disk.
    Files,
    /// That of what was trained, from which another attempt would come to the same.
    Training,
    /// Anything else of the cell.
    Other,
}

/// A cell that is to be done.
#[derive(Clone, Debug)]
pub struct CellOrder<'a> {
    /// What is to be done.
    pub cell: &'a Cell,
    /// Where it is kept.
    pub folder: CellFolder,
    /// The failure that may be forgotten, and no other.
    pub retry: Option<FailureMark>,
}

/// A cell in work.
struct Work<'a> {
    order: &'a CellOrder<'a>,
    _lock: Lock,
    /// Where and from where it is to be trained; `None` if it has been.
    training: Option<(RunDirectory, Start)>,
    /// What came of that: `None` of one that was stopped, or has not ended.
    trained: Option<Result<Checkpoint, Broken>>,
}

/// Why a cell has no result.
#[derive(Clone, Debug)]
struct Broken {
    reason: String,
    fault: Fault,
}

/// Trains and tests the cells of `orders`, which have the same environment and architecture: trains all in lockstep over one
/// session, and then tests one after the other. Leaves alone those that are done, have failed otherwise than they may, or
/// that others work on. Calls `tell` with what is being done with each cell, and at last, once, with how that ended: an
/// event that is [last](CellEvent::is_last).
///
/// What goes wrong with a cell is recorded in its folder, and the others go on. All that are left have lost their server
/// if one has, and are stopped by `stop`.
pub fn run_cells(servers: &Servers, orders: &[CellOrder<'_>], stop: &StopFlag, tell: &mut dyn FnMut(&Cell, CellEvent)) {
    let mut all = Vec::new();
    for order in orders {
        match Work::begin(order, tell) {
            Ok(work) => all.push(work),
            Err(end) => tell(order.cell, end),
        }
    }
    let begun = Instant::now();
    let places: Vec<usize> = (0..all.len()).filter(|&place| all[place].training.is_some()).collect();
    if let Err(broken) = train(servers, &mut all, &places, stop, tell) {
        let left: Vec<usize> = places.iter().copied().filter(|&place| all[place].trained.is_none()).collect();
        for place in left {
            // One that is refused must not keep the others from their turn, nor a server that has no room for all at once.
            let alone = if places.len() == 1 || broken.fault == Fault::Server {
                Err(broken.clone())
            } else {
                all[place].look_back_again(tell).and_then(|()| train(servers, &mut all, &[place], stop, tell))
            };
            if let Err(broken) = alone {
                all[place].trained = Some(Err(broken));
            }
        }
    }
    // Each cell's share of the time in which all were trained.
    let share = begun.elapsed().as_secs_f64() / places.len().max(1) as f64;
    let mut lost = None;
    for work in all {
        let cell = work.order.cell;
        let end = match (&lost, stop.signal()) {
            (_, Some(signal)) => CellEvent::Stopped { signal },
            (Some(reason), None) => CellEvent::LostServer { reason: String::clone(reason) },
            (None, None) => work.end(servers, share, stop, &mut |event| tell(cell, event)).unwrap_or_else(failed),
        };
        if let CellEvent::LostServer { reason } = &end {
            lost.get_or_insert_with(|| reason.clone());
        }
        tell(cell, end);
    }
}

/// Trains those in `places` together.
///
/// # Errors
/// What ended all that have not ended.
fn train(
    servers: &Servers,
    all: &mut [Work<'_>],
    places: &[usize],
    stop: &StopFlag,
    tell: &mut dyn FnMut(&Cell, CellEvent),
) -> Result<(), Broken> {
    let places: Vec<usize> = places.iter().copied().filter(|&place| all[place].training.is_some()).collect();
    if places.is_empty() {
        return Ok(());
    }
    let entry = |&place: &usize| {
        let Work { order, training, .. } = &all[place];
        let (directory, start) = training.as_ref()?;
        Some(Entry { directory, start: start.clone(), marks: &order.cell.tests.marks })
    };
    let entries = places.iter().filter_map(entry).collect();
    let cells: Vec<&Cell> = places.iter().map(|&place| all[place].order.cell).collect();
    let mut outcomes: Vec<(usize, Result<Outcome, TrainError>)> = Vec::new();
    let mut report = |index: usize, &Progress { episodes, timesteps, saved_timesteps: saved, .. }: &Progress| {
        tell(cells[index], CellEvent::Training { episodes, timesteps, saved });
    };
    let ended = &mut |index: usize, outcome| outcomes.push((index, outcome));
    let all_ended = train_together(servers, entries, 1, stop, &mut report, ended);
    for (index, outcome) in outcomes {
        let work = &mut all[places[index]];
        work.trained = match outcome {
            Err(error) => Some(Err(CellError::from(error).into())),
            Ok(outcome) => {
                let Counters { episodes, timesteps, .. } = outcome.checkpoint.state.counters;
                tell(work.order.cell, CellEvent::Training { episodes, timesteps, saved: timesteps });
                outcome.signal.is_none().then_some(Ok(outcome.checkpoint))
            }
        };
    }
    all_ended.map_err(|error| CellError::from(error).into())
}

impl<'a> Work<'a> {
    /// Takes the cell, or says how it has ended already.
    fn begin(order: &'a CellOrder<'a>, tell: &mut dyn FnMut(&Cell, CellEvent)) -> Result<Self, CellEvent> {
        let CellOrder { folder, retry, .. } = order;
        let Some(lock) = folder.try_lock().map_err(failed)? else { return Err(CellEvent::Busy) };
        match folder.state().map_err(failed)? {
            CellState::Done(_) => return Err(CellEvent::Done),
            CellState::Failed(failure) if folder.failure_mark() != *retry => {
                return Err(CellEvent::Failed { reason: failure.reason });
            }
            CellState::Failed(_) => folder.forget_failure().map_err(failed)?,
            CellState::Missing => {}
        }
        let mut work = Self { order, _lock: lock, training: None, trained: None };
        match work.look_back(tell) {
            Ok(()) => {}
            Err(error) => work.trained = Some(Err(CellError::from(TrainError::from(error)).into())),
        }
        Ok(work)
    }

    /// Decides what becomes of a training that was broken off: one that had finished is taken as it is, another goes on
    /// from its last checkpoint, to the same bytes as without the break, and one without a usable checkpoint begins again.
    fn look_back(&mut self, tell: &mut dyn FnMut(&Cell, CellEvent)) -> Result<(), RunDirectoryError> {
        let Cell { config, tests, .. } = self.order.cell;
        let path = self.order.folder.training();
        let over = |(_, checkpoint, state): &(RunDirectory, Checkpoint, ResumeState)| {
            is_over(&config.common, &checkpoint.state.counters, state.history.recent.iter())
        };
        let mut earlier = earlier(&path)?;
        if let Some(there @ (directory, checkpoint, _)) = &earlier {
            let past = |mark: &u64| over(there) || *mark <= checkpoint.state.counters.episodes;
            let has_kept = directory.has_kept(tests.marks.iter().copied().filter(past))?;
            if checkpoint.state.config != *config || !has_kept {
                earlier = None;
            }
        }
        let Counters { episodes, timesteps, .. } =
            earlier.as_ref().map_or_else(Counters::default, |(_, checkpoint, _)| checkpoint.state.counters);
        tell(self.order.cell, CellEvent::Training { episodes, timesteps, saved: timesteps });
        match earlier {
            Some(earlier) if over(&earlier) => self.trained = Some(Ok(earlier.1)),
            Some((directory, checkpoint, state)) => {
                self.training = Some((directory, Start::Checkpoint(Box::new((checkpoint, state)))));
            }
            None => self.training = Some((RunDirectory::choose(&path, true)?, Start::Fresh(Box::new(config.clone())))),
        }
        Ok(())
    }

    /// The same after an attempt that may have left a checkpoint.
    fn look_back_again(&mut self, tell: &mut dyn FnMut(&Cell, CellEvent)) -> Result<(), Broken> {
        self.training = None; // its directory is locked by it
        self.look_back(tell).map_err(|error| CellError::from(TrainError::from(error)).into())
    }

    /// Tests what was trained in so many seconds, writes the result, and says how that ended.
    ///
    /// # Errors
    /// [`FolderError`]: the folder cannot be read or written. Whatever else goes wrong is recorded in it.
    fn end(
        self,
        servers: &Servers,
        seconds: f64,
        stop: &StopFlag,
        tell: &mut dyn FnMut(CellEvent),
    ) -> Result<CellEvent, FolderError> {
        let CellOrder { cell, folder, .. } = self.order;
        let testing = Instant::now();
        let tested = match self.trained {
            None => return Ok(CellEvent::Stopped { signal: stop.signal().unwrap_or(SIGTERM) }),
            Some(Err(broken)) => Err(broken),
            Some(Ok(checkpoint)) => result::tested(servers, cell, folder, checkpoint, stop, tell).map_err(Broken::from),
        };
        let seconds = if self.training.is_some() { seconds } else { 0.0 } + testing.elapsed().as_secs_f64();
        match (tested, stop.signal()) {
            (Ok(Some(result)), _) => {
                folder.write_timing(&Timing { seconds })?;
                folder.write_result(&result)?; // last: whoever sees it may read everything else
                Ok(CellEvent::Done)
            }
            (Ok(None), signal) => Ok(CellEvent::Stopped { signal: signal.unwrap_or(SIGTERM) }),
            // Whoever stops a run may end its servers too.
            (Err(_), Some(signal)) => Ok(CellEvent::Stopped { signal }),
            (Err(Broken { reason, fault: Fault::Server | Fault::Room }), None) => Ok(CellEvent::LostServer { reason }),
            (Err(Broken { reason, fault: Fault::Files }), None) => Ok(CellEvent::FileFault { reason }),
            (Err(Broken { reason, fault }), None) => {
                // Without the folder's place: wherever the same happens, the same is recorded.
                let reason = reason.replace(&format!("{}/", folder.path().display()), "");
                let (commit, begins_anew) = (perturb_experiment::VERSION.into(), fault == Fault::Training);
                let failure = Failure { id: cell.id.clone(), reason, commit, begins_anew };
                folder.write_failure(&failure)?;
                Ok(CellEvent::Failed { reason: failure.reason })
            }
        }
    }
}

impl From<CellError> for Broken {
    fn from(error: CellError) -> Self {
        Self { reason: error.to_string(), fault: error.fault() }
    }
}

/// How a cell ends whose folder cannot be read or written.
fn failed(error: impl Into<FolderError>) -> CellEvent {
    let error = error.into();
    let reason = error.to_string();
    match error {
        FolderError::File(error) if error.is_fault() => CellEvent::FileFault { reason },
        _ => CellEvent::Failed { reason },
    }
}

/// What is left of a training that was broken off; `None` if there is nothing that could go on.
///
/// # Errors
/// Whatever else keeps it from being read, a lock for instance: then it may still go on later, and is left as it is.
fn earlier(directory: &Path) -> Result<Option<(RunDirectory, Checkpoint, ResumeState)>, RunDirectoryError> {
    match RunDirectory::resume(directory) {
        Ok(earlier) => Ok(Some(earlier)),
        Err(RunDirectoryError::Missing { .. }) => Ok(None),
        Err(error) if error.is_hopeless() => {
            tracing::warn!("the training begins again: {error}");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_training_that_cannot_be_read_now_is_not_begun_again() {
        let directory = tempfile::tempdir().unwrap();
        let training = directory.path().join("training");
        assert!(earlier(&training).unwrap().is_none(), "nothing there");
        let checkpoint = training.join("checkpoint");
        std::fs::create_dir_all(&checkpoint).unwrap();
        assert!(earlier(&training).unwrap().is_none(), "broken off before the first checkpoint");
        std::fs::write(checkpoint.join("checkpoint.json"), "{").unwrap();
        assert!(earlier(&training).unwrap().is_none(), "damaged");
        let (newer, json) = (r#"{"format_version": 99, "unheard_of": 1}"#, checkpoint.join("checkpoint.json"));
        std::fs::write(&json, newer).unwrap();
        let Err(error) = earlier(&training) else { panic!("a newer program goes on with it") };
        assert!(error.to_string().contains("has format 99"), "{error}");
        std::fs::remove_file(&json).unwrap();
        std::os::unix::fs::symlink(&json, &json).unwrap(); // which the system cannot follow
        let Err(error) = earlier(&training) else { panic!("what cannot be seen may be there") };
        assert!(error.to_string().starts_with("cannot look for "), "{error}");
        let lock = std::fs::File::open(&training).unwrap();
        lock.try_lock().unwrap();
        let Err(error) = earlier(&training) else { panic!("it is locked") };
        assert!(error.to_string().contains("another process trains in"), "{error}");
    }
}
