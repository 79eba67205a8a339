//! Runs cells of an experiment: trains, tests, and writes the results.

mod result;

use std::path::Path;
use std::time::Instant;

use perturb_checkpoint::Counters;
use perturb_experiment::scheduler::CellEvent;
use perturb_experiment::{Cell, CellFolder, CellState, FailureId, FailureRecord, FolderError, Timing};
use perturb_files::Lock;
use perturb_files::interrupt::StopFlag;
use perturb_records::RecordsError;

use crate::checkpoint::{Checkpoint, ResumeState};
use crate::client::Servers;
use crate::evaluation::TestError;
use crate::logging::Progress;
use crate::training::{
    RunDirectory, RunDirectoryError, Start, TrainError, TrainOutcome, TrainRequest, is_over, train_together,
};

/// The signal number to report if a cell was stopped without a signal.
const SIGTERM: i32 = 15;

/// The reason why a cell has no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CellError {
    /// The training failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// The test failed.
    #[error(transparent)]
    Test(#[from] TestError),
    /// The test episodes cannot be recorded.
    #[error(transparent)]
    Records(#[from] RecordsError),
}

impl CellError {
    /// Classifies the cause of the failure.
    fn fault(&self) -> Fault {
        match self {
            Self::Train(error) if error.is_server_full() => Fault::Room,
            Self::Train(error) if error.can_be_retried() => Fault::Server,
            Self::Test(error) if error.can_be_retried() => Fault::Server,
            Self::Train(error) if error.is_file_fault() => Fault::Files,
            Self::Records(RecordsError::File(error)) if error.is_fault() => Fault::Files,
            Self::Train(error) if error.requires_restart() => Fault::Training,
            Self::Test(TestError::Numbers(_)) => Fault::Training,
            _ => Fault::Other,
        }
    }
}

/// The class of a failure's cause. It decides whether the failure is recorded, and how the cell is tried again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// The server or the connection to it has failed.
    Server,
    /// The server has no room for this many environments.
    Room,
    /// The machine could not read or write a file, for example because a disk is full. A missing file is not such a
    /// fault.
    Files,
    /// The training or its policy has numbers that are not valid, for example NaN. Resuming from the checkpoint would
    /// fail in the same way.
    Training,
    /// Any other cause.
    Other,
}

/// A cell to run, with its folder.
#[derive(Clone, Debug)]
pub struct CellJob<'a> {
    /// The cell in the plan.
    pub cell: &'a Cell,
    /// The folder of the cell's files in the experiment's folder.
    pub folder: CellFolder,
    /// The recorded failure that may be deleted to run the cell again. A cell with any other recorded failure is
    /// skipped, and its record is kept.
    pub retry: Option<FailureId>,
}

/// A cell that this process has locked and is running.
struct RunningCell<'a> {
    job: &'a CellJob<'a>,
    _lock: Lock,
    /// The directory of the training, and where it starts; `None` if the cell is already trained.
    training: Option<(RunDirectory, Start)>,
    /// The result of the training; `None` if it has not ended or was stopped.
    trained: Option<Result<Checkpoint, CellFailure>>,
}

/// The reason why a cell has no result, as text, and the class of the failure.
#[derive(Clone, Debug)]
struct CellFailure {
    reason: String,
    fault: Fault,
}

/// Runs the cells of `jobs`, which must have the same environment and architecture: trains all of them together, and
/// then tests one after the other.
///
/// Skips cells that are done, that another process is running, or that have a failure other than `retry`. Calls `tell`
/// with progress events of each cell. The last call for a cell is its final event, for which [`CellEvent::is_last`] is
/// true.
///
/// A failure of a cell is recorded in its folder, and the other cells continue. If one cell loses its server, the
/// remaining cells end with [`CellEvent::LostServer`]. `stop` interrupts all cells.
pub fn run_cells(servers: &Servers, jobs: &[CellJob<'_>], stop: &StopFlag, tell: &mut dyn FnMut(&Cell, CellEvent)) {
    let mut all = Vec::new();
    for job in jobs {
        match RunningCell::lock(job, tell) {
            Ok(work) => all.push(work),
            Err(end) => tell(job.cell, end),
        }
    }
    let begun = Instant::now();
    let places: Vec<usize> = (0..all.len()).filter(|&place| all[place].training.is_some()).collect();
    if let Err(failure) = train(servers, &mut all, &places, stop, tell) {
        let left: Vec<usize> = places.iter().copied().filter(|&place| all[place].trained.is_none()).collect();
        for place in left.into_iter().take_while(|_| stop.signal().is_none()) {
            // The joint training was interrupted. The cause may be one faulty cell, or a server without room for all
            // cells at once. So each unfinished cell is trained again alone, unless the server was lost.
            let alone = if places.len() == 1 || failure.fault == Fault::Server {
                Err(failure.clone())
            } else {
                all[place].recover_after_failure(tell).and_then(|()| train(servers, &mut all, &[place], stop, tell))
            };
            if let Err(failure) = alone {
                all[place].trained = Some(Err(failure));
            }
        }
    }
    // The cells share the training time equally, because they were trained together.
    let share = begun.elapsed().as_secs_f64() / places.len().max(1) as f64;
    let mut lost = None;
    for work in all {
        let cell = work.job.cell;
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

/// Trains the cells with the indices `places` in `all` together, and stores each result in its cell.
///
/// # Errors
/// The failure that interrupted the joint training. Cells whose training had not ended then have no stored result.
fn train(
    servers: &Servers,
    all: &mut [RunningCell<'_>],
    places: &[usize],
    stop: &StopFlag,
    tell: &mut dyn FnMut(&Cell, CellEvent),
) -> Result<(), CellFailure> {
    let places: Vec<usize> = places.iter().copied().filter(|&place| all[place].training.is_some()).collect();
    if places.is_empty() {
        return Ok(());
    }
    let entry = |&place: &usize| {
        let RunningCell { job, training, .. } = &all[place];
        let (directory, start) = training.as_ref()?;
        Some(TrainRequest { directory, start: start.clone(), marks: &job.cell.tests.marks })
    };
    let entries = places.iter().filter_map(entry).collect();
    let cells: Vec<&Cell> = places.iter().map(|&place| all[place].job.cell).collect();
    let mut outcomes: Vec<(usize, Result<TrainOutcome, TrainError>)> = Vec::new();
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
                tell(work.job.cell, CellEvent::Training { episodes, timesteps, saved: timesteps });
                outcome.signal.is_none().then_some(Ok(outcome.checkpoint))
            }
        };
    }
    all_ended.map_err(|error| CellError::from(error).into())
}

impl<'a> RunningCell<'a> {
    /// Locks the cell and prepares its training. The error is the final event of a cell that must not be run: it is
    /// done, has failed earlier, or is locked by another process.
    fn lock(job: &'a CellJob<'a>, tell: &mut dyn FnMut(&Cell, CellEvent)) -> Result<Self, CellEvent> {
        let CellJob { folder, retry, .. } = job;
        let Some(lock) = folder.try_lock().map_err(failed)? else { return Err(CellEvent::Busy) };
        match folder.state().map_err(failed)? {
            CellState::Done(_) => return Err(CellEvent::Done),
            CellState::Failed(failure) if folder.failure_id() != *retry => {
                return Err(CellEvent::Failed { reason: failure.reason });
            }
            CellState::Failed(_) => folder.clear_failure().map_err(failed)?,
            CellState::Missing => {}
        }
        let mut work = Self { job, _lock: lock, training: None, trained: None };
        match work.recover(tell) {
            Ok(()) => {}
            Err(error) => work.trained = Some(Err(CellError::from(TrainError::from(error)).into())),
        }
        Ok(work)
    }

    /// Finds out how to continue the cell's training. If the training has finished, its policy only needs tests. An
    /// unfinished training resumes from its last checkpoint, with the same bytes as without the interruption. The
    /// training restarts if it has no usable checkpoint, if the plan's settings have changed, or if an intermediate
    /// policy that the tests need is missing.
    fn recover(&mut self, tell: &mut dyn FnMut(&Cell, CellEvent)) -> Result<(), RunDirectoryError> {
        let Cell { config, tests, .. } = self.job.cell;
        let path = self.job.folder.training();
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
        tell(self.job.cell, CellEvent::Training { episodes, timesteps, saved: timesteps });
        match earlier {
            Some(earlier) if over(&earlier) => self.trained = Some(Ok(earlier.1)),
            Some((directory, checkpoint, state)) => {
                self.training = Some((directory, Start::Checkpoint(Box::new((checkpoint, state)))));
            }
            None => self.training = Some((RunDirectory::choose(&path, true)?, Start::Fresh(Box::new(config.clone())))),
        }
        Ok(())
    }

    /// Prepares another attempt at the training after a failed one, which may have left a checkpoint.
    fn recover_after_failure(&mut self, tell: &mut dyn FnMut(&Cell, CellEvent)) -> Result<(), CellFailure> {
        self.training = None; // releases the directory's lock, which `recover` takes again
        self.recover(tell).map_err(|error| CellError::from(TrainError::from(error)).into())
    }

    /// Tests the trained policy and writes the result of the cell. `seconds` is the duration of the training. Returns
    /// the cell's final event.
    ///
    /// # Errors
    /// [`FolderError`] if the cell's folder cannot be read or written. Other failures are recorded in the folder.
    fn end(
        self,
        servers: &Servers,
        seconds: f64,
        stop: &StopFlag,
        tell: &mut dyn FnMut(CellEvent),
    ) -> Result<CellEvent, FolderError> {
        let CellJob { cell, folder, .. } = self.job;
        let testing = Instant::now();
        let tested = match self.trained {
            None => return Ok(CellEvent::Stopped { signal: stop.signal().unwrap_or(SIGTERM) }),
            Some(Err(failure)) => Err(failure),
            Some(Ok(checkpoint)) => {
                result::tested(servers, cell, folder, checkpoint, stop, tell).map_err(CellFailure::from)
            }
        };
        let seconds = if self.training.is_some() { seconds } else { 0.0 } + testing.elapsed().as_secs_f64();
        match (tested, stop.signal()) {
            (Ok(Some(result)), _) => {
                folder.write_timing(&Timing { seconds })?;
                folder.write_result(&result)?; // last, because its presence means that all other files are complete
                Ok(CellEvent::Done)
            }
            (Ok(None), signal) => Ok(CellEvent::Stopped { signal: signal.unwrap_or(SIGTERM) }),
            // A stopped run reports no failure, because the signal may have ended the run's servers too.
            (Err(_), Some(signal)) => Ok(CellEvent::Stopped { signal }),
            (Err(CellFailure { reason, fault: Fault::Server | Fault::Room }), None) => {
                Ok(CellEvent::LostServer { reason })
            }
            (Err(CellFailure { reason, fault: Fault::Files }), None) => Ok(CellEvent::FileFault { reason }),
            (Err(CellFailure { reason, fault }), None) => {
                // Removes the folder's path, so that the same failure has the same text in every folder.
                let reason = reason.replace(&format!("{}/", folder.path().display()), "");
                let commit = perturb_experiment::VERSION.into();
                let requires_restart = fault == Fault::Training;
                let failure = FailureRecord { id: cell.id.clone(), reason, commit, requires_restart };
                folder.write_failure(&failure)?;
                Ok(CellEvent::Failed { reason: failure.reason })
            }
        }
    }
}

impl From<CellError> for CellFailure {
    fn from(error: CellError) -> Self {
        Self { reason: error.to_string(), fault: error.fault() }
    }
}

/// Returns the final event of a cell whose folder cannot be read or written.
fn failed(error: impl Into<FolderError>) -> CellEvent {
    let error = error.into();
    let reason = error.to_string();
    match error {
        FolderError::File(error) if error.is_fault() => CellEvent::FileFault { reason },
        _ => CellEvent::Failed { reason },
    }
}

/// Reads the last checkpoint of an earlier attempt at the training. Returns `None` if there is nothing to resume.
///
/// # Errors
/// A failure that may be temporary, for example the lock of another process. The training may be resumable later, so
/// nothing is changed.
fn earlier(directory: &Path) -> Result<Option<(RunDirectory, Checkpoint, ResumeState)>, RunDirectoryError> {
    match RunDirectory::resume(directory) {
        Ok(earlier) => Ok(Some(earlier)),
        Err(RunDirectoryError::Missing { .. }) => Ok(None),
        Err(error) if error.is_unrecoverable() => {
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
        assert!(earlier(&training).unwrap().is_none(), "interrupted before the first checkpoint");
        std::fs::write(checkpoint.join("checkpoint.json"), "{").unwrap();
        assert!(earlier(&training).unwrap().is_none(), "damaged");
        let (newer, json) = (r#"{"format_version": 99, "unheard_of": 1}"#, checkpoint.join("checkpoint.json"));
        std::fs::write(&json, newer).unwrap();
        let Err(error) = earlier(&training) else { panic!("a newer program goes on with it") };
        assert!(error.to_string().contains("has format 99"), "{error}");
        std::fs::remove_file(&json).unwrap();
        std::os::unix::fs::symlink(&json, &json).unwrap(); // a link to itself cannot be followed
        let Err(error) = earlier(&training) else { panic!("what cannot be seen may be there") };
        assert!(error.to_string().starts_with("cannot look for "), "{error}");
        let _lock = perturb_files::Lock::try_take(&training).unwrap().unwrap();
        let Err(error) = earlier(&training) else { panic!("it is locked") };
        assert!(error.to_string().contains("another process trains in"), "{error}");
    }
}
