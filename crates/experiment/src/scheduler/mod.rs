//! Runs the cells of a plan on this machine or on a cluster.
//!
//! [`run()`] repeatedly polls a [`Backend`], which starts groups of cells and reports events of each cell. There are
//! two backends: [`Local`] uses processes of this machine, [`slurm`] uses jobs of a cluster. A cell is settled when the
//! experiment's folder has its result, or a failure that is not retried. Only the folder decides this, so several runs
//! with different backends may share a folder.

mod event;
mod local;
mod rates;
mod running;
pub mod slurm;

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use perturb_files::FileError;
use perturb_files::interrupt::StopFlag;
use perturb_text::{count, duration};

use crate::cost::generated_episodes;
use crate::eta::{CellDurations, RemainingTime, TrainingProgress, UnfinishedCell, remaining_time};
use crate::folder::{CellState, ExperimentFolder, FailureId, FailureRecord};
use crate::plan::{Cell, Grouping, Plan, SELECTION_TEST, Tests};
pub use event::{CellEvent, EventLine, EventLineWriter, JobCell, WorkerJob, write_line};
pub use local::Local;
pub use rates::Rate;
pub(crate) use rates::Rates;
use running::Running;
pub use running::RunningGroup;
use slurm::SlurmError;

/// Maximum number of successive attempts at a cell that end without progress.
pub const MAX_ATTEMPTS: u32 = 3;
/// Number of successive attempts at a cell that end with [`CellEvent::FileFault`], after which the run ends. With the
/// pauses between attempts, this takes some fifteen seconds.
const MAX_FAULTS: u32 = 5;
/// Minimum time that a cell waits for a lost server before the run ends, because a server may be restarting.
const MIN_SERVER_WAIT: Duration = Duration::from_secs(15);
/// Duration of a connection to a server after which earlier losses no longer count: the next loss starts a new count of
/// successive losses.
const STABLE_CONNECTION: Duration = Duration::from_secs(60);
/// Pause after an attempt that lost its server or could not read or write a file. The pause doubles with each further
/// attempt that ends in the same way.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
/// Maximum pause after an attempt that lost its server or could not read or write a file.
const MAX_PAUSE: Duration = Duration::from_secs(30);
/// Minimum interval between reads of the folder. Each read is followed by a [`ProgressEvent::Status`].
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Duration of a test episode divided by that of a training episode. Tests have no updates and run many environments
/// together.
const TEST_SHARE: f64 = 0.25;
/// Pause between two steps of the scheduler.
const TICK: Duration = Duration::from_millis(50);

/// A way to run groups of cells, for example in local processes. The scheduler decides which cells start, and the
/// backend runs them.
pub trait Backend {
    /// Returns how cells are divided into groups.
    fn grouping(&self) -> Grouping;
    /// Returns whether a cell whose process died too often is recorded as failed. Backends return false if faulty
    /// machines may be the cause; then the next run tries the cell again.
    fn records_crashes_as_failures(&self) -> bool;
    /// Returns whether the backend reports the end of every started cell. If not, the scheduler looks for results in
    /// the folder.
    fn reports_ends(&self) -> bool;
    /// Returns the events since the last call.
    ///
    /// # Errors
    /// [`RunError`] if the run cannot continue.
    fn poll(&mut self, now: Instant) -> Result<Vec<BackendEvent>>;
    /// Returns the number of groups that can start now.
    fn free_slots(&self) -> usize;
    /// Starts some of `groups`, none of which may be empty. Returns the indices of those offered cells that are now
    /// running or queued, including cells that an earlier process has queued.
    ///
    /// # Errors
    /// [`RunError`] if the run cannot continue.
    fn begin(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<usize>>;
    /// Returns a description of the backend's activity for users, and the number of groups that run in parallel.
    fn load(&self) -> (String, usize);
    /// Returns a measured upper bound of a cell's duration in seconds of process time; `None` if there is no
    /// measurement.
    fn max_seconds(&self, _cell: usize) -> Option<f64> {
        None
    }
    /// Ends all work that needs this process. Returns the names of work that continues without this process, such as
    /// jobs of a cluster.
    fn stop(&mut self) -> Vec<String>;
}

/// A cell that is waiting to be started.
#[derive(Clone, Copy, Debug)]
pub struct PendingCell {
    /// The index of the cell in the plan.
    pub cell: usize,
    /// The recorded failure that this attempt may delete; `None` if there is none.
    pub retry: Option<FailureId>,
    /// The number of the cell's group in this run. It stays the same when the cell is started again alone.
    pub group: usize,
    /// The number of times that the cell lost its server in this run.
    pub lost_servers: usize,
    /// The mean process time of finished cells with the same environment and method, in seconds; `None` if none has
    /// finished.
    pub seconds: Option<f64>,
}

/// An event of a backend. Cells are indices in the plan.
#[derive(Clone, Debug, PartialEq)]
pub enum BackendEvent {
    /// An event of the cell with this index.
    Event(usize, CellEvent),
    /// The backend did not start this cell, and hands it back to the scheduler.
    Returned(usize),
    /// The servers have ended, for this reason.
    NoServer(String),
    /// A sentence to show to the user.
    Note(String),
}

/// A progress message of a run.
#[derive(Clone, Debug)]
pub enum ProgressEvent<'a> {
    /// The current status of the run.
    Status(&'a RunStatus),
    /// A sentence to show to the user.
    Note(&'a str),
    /// An event of a cell.
    Line(&'a EventLine),
}

/// The status of a run, for display.
#[derive(Clone, Debug)]
pub struct RunStatus {
    /// Number of cells in the plan.
    pub cells: usize,
    /// Number of cells with a result.
    pub done: usize,
    /// Number of cells with a failure that is not retried.
    pub failed: usize,
    /// The groups that are running.
    pub running: Vec<RunningGroup>,
    /// A description of the backend's activity.
    pub doing: String,
    /// The estimated remaining time; `None` if the duration of some cell cannot be estimated yet.
    pub remaining: Option<RemainingTime>,
    /// Mean success rates of finished cells.
    pub rates: Vec<Rate>,
}

/// The end of a run without an error.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RunEnd {
    /// All cells have a result or have failed.
    Finished {
        /// The ids of the failed cells.
        failed: Vec<String>,
    },
    /// A signal stopped the run. The same command resumes it.
    Stopped {
        /// The signal's number.
        signal: i32,
        /// Names of work that continues without this process: jobs of a cluster.
        left: Vec<String>,
    },
}

/// The reason why a run cannot continue.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The folder cannot be read or written, or a worker cannot be started.
    #[error(transparent)]
    File(#[from] FileError),
    /// A worker's copy of the plan does not have the requested cells.
    #[error("a worker refused its job: {0}; did another run replace the folder's plan.toml meanwhile?")]
    Refused(String),
    /// The servers have ended.
    #[error("the run cannot continue without a server: {0}; finished work is kept")]
    NoServer(String),
    /// Files of a cell repeatedly could not be read or written.
    #[error("the run cannot continue: {0}; fix this, and resume with the same command")]
    FileFault(String),
    /// Several attempts at a cell ended without progress.
    #[error(
        "{} without a result after {MAX_ATTEMPTS} attempts; the first is {}: {words}; fix the cause, then \
         run the same command again",
        count(ids.len(), "cell"),
        ids[0]
    )]
    GaveUp {
        /// The ids of the cells that were given up, at least one.
        ids: Vec<String>,
        /// A description of how the last attempt at the first of these cells ended.
        words: String,
    },
    /// Slurm cannot run the cells.
    #[error(transparent)]
    Slurm(#[from] SlurmError),
}

type Result<T, E = RunError> = std::result::Result<T, E>;

/// Runs every cell of `plan` that has no result in `folder`, and returns when all cells are settled.
///
/// A failed cell is run again if `retryable` has its failure, by cell id. If another run is working on a cell, waits
/// for its result. A cell that loses its server waits for a server and then resumes from its last checkpoint. After
/// `server_wait`, but at least 15 s, without a server the run ends with an error. `report` receives progress messages.
/// `stop` interrupts the run.
///
/// # Errors
/// [`RunError`] if the run cannot continue. The backend is stopped first.
pub fn run(
    plan: &Plan,
    folder: &ExperimentFolder,
    backend: &mut dyn Backend,
    retryable: &HashMap<String, FailureId>,
    server_wait: Duration,
    stop: &StopFlag,
    report: &mut dyn FnMut(ProgressEvent<'_>),
) -> Result<RunEnd> {
    let mut scheduler = Scheduler { server_wait, ..Scheduler::new(plan, folder, backend, retryable, report) };
    let end = loop {
        match (scheduler.step(Instant::now()), stop.signal()) {
            (Ok(None), None) => std::thread::sleep(TICK),
            (Ok(Some(failed)), _) => break Ok(RunEnd::Finished { failed }),
            (Err(error), None) => break Err(error),
            // The signal may have ended servers and commands too, so an error is ignored.
            (_, Some(signal)) => break Ok(RunEnd::Stopped { signal, left: scheduler.backend.stop() }),
        }
    };
    scheduler.backend.stop();
    end
}

/// The scheduler's state for one cell.
#[derive(Debug, Default)]
struct Tracked {
    phase: CellPhase,
    /// The number of the cell's group.
    group: usize,
    /// Whether the cell runs alone because an earlier attempt ended without progress. A cell that crashes alone does
    /// not interrupt other cells.
    alone: bool,
    /// A failure recorded before this run, which this run retries. Any later failure makes the cell failed.
    retryable: Option<FailureId>,
    /// Number of successive attempts that ended without progress.
    attempts: u32,
    /// Number of training steps in the last checkpoint.
    saved: u64,
    /// Value of `saved` when the current attempt started its training.
    saved_before: Option<u64>,
    /// The progress of the current attempt.
    progress: TrainingProgress,
    lost_servers: usize,
    /// Number of successive attempts that lost their server.
    lost_in_a_row: u32,
    /// Sum of the pauses after the attempts that `lost_in_a_row` counts.
    waited: Duration,
    /// Number of successive attempts that could not read or write a file, without a new checkpoint in between.
    faults_in_a_row: u32,
    /// The time of the first event of the current attempt. Time in a cluster's queue therefore does not count.
    begun: Option<Instant>,
    /// The time at which the current attempt first had a server.
    served: Option<Instant>,
    /// The last event of the current attempt.
    last: Option<CellEvent>,
}

/// The phase of a cell in this run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum CellPhase {
    #[default]
    Waiting,
    Running,
    /// A process of another run is working on the cell.
    LockedByOther,
    Done,
    Failed,
    /// Too many attempts ended without progress, and no failure is recorded.
    GivenUp,
}

/// The state of a run: decides which cells the backend starts, and handles its events.
struct Scheduler<'a> {
    plan: &'a Plan,
    folder: &'a ExperimentFolder,
    backend: &'a mut dyn Backend,
    report: &'a mut dyn FnMut(ProgressEvent<'_>),
    /// The state of each cell, by its index in the plan.
    cells: Vec<Tracked>,
    /// Indices of the waiting cells, in order.
    queue: VecDeque<usize>,
    durations: CellDurations<'a>,
    rates: Rates,
    /// No cell is started before this time, see [`Scheduler::pause`].
    paused_until: Option<Instant>,
    /// Maximum time that a cell waits for lost servers, see [`run()`].
    server_wait: Duration,
    /// The time of the next search for results in the folder.
    next_poll: Option<Instant>,
}

impl<'a> Scheduler<'a> {
    fn new(
        plan: &'a Plan,
        folder: &'a ExperimentFolder,
        backend: &'a mut dyn Backend,
        retryable: &HashMap<String, FailureId>,
        report: &'a mut dyn FnMut(ProgressEvent<'_>),
    ) -> Self {
        let retryable = |id| retryable.get(id).copied();
        let cells = plan.cells.iter().map(|cell| Tracked { retryable: retryable(&cell.id), ..Tracked::default() });
        let mut scheduler = Self {
            plan,
            folder,
            backend,
            report,
            cells: cells.collect(),
            queue: VecDeque::new(),
            durations: CellDurations::default(),
            rates: Rates::default(),
            paused_until: None,
            server_wait: Duration::ZERO,
            next_poll: None,
        };
        // Divides the unfinished cells into groups, and queues them.
        let left: Vec<usize> = (0..plan.cells.len()).filter(|&cell| !scheduler.settled(cell)).collect();
        let groups = plan.groups(&left, scheduler.backend.grouping());
        for (number, group) in groups.into_iter().enumerate() {
            group.iter().for_each(|&cell| scheduler.cells[cell].group = number);
            scheduler.queue.extend(group);
        }
        scheduler
    }

    /// Handles new events and starts the cells that can start. Returns the ids of the failed cells when all cells are
    /// settled, otherwise `None`.
    fn step(&mut self, now: Instant) -> Result<Option<Vec<String>>> {
        for event in self.backend.poll(now)? {
            match event {
                BackendEvent::Note(sentence) => (self.report)(ProgressEvent::Note(&sentence)),
                BackendEvent::NoServer(reason) => return Err(RunError::NoServer(reason)),
                BackendEvent::Returned(cell) if self.settled(cell) => {}
                BackendEvent::Returned(cell) => self.wait(cell),
                BackendEvent::Event(cell, event) => self.on_event(cell, event, now)?,
            }
        }
        let looks = self.next_poll.is_none_or(|time| now >= time);
        if looks {
            self.poll_results(now)?;
        }
        self.begin(now)?;
        let end = self.end();
        if looks || matches!(end, Ok(Some(_))) {
            let status = self.status(now);
            (self.report)(ProgressEvent::Status(&status));
        }
        end
    }

    /// Handles an event of a cell: reports it, and updates the cell's state.
    fn on_event(&mut self, cell: usize, event: CellEvent, now: Instant) -> Result<()> {
        let line = EventLine { cell: self.id(cell).to_owned(), event: event.clone() };
        (self.report)(ProgressEvent::Line(&line));
        let tracked = &mut self.cells[cell];
        tracked.last = Some(event.clone());
        tracked.begun.get_or_insert(now);
        match event {
            CellEvent::Server { .. } => tracked.served = tracked.served.or(Some(now)),
            CellEvent::Training { saved, episodes, timesteps } => {
                tracked.progress.update(generated_episodes(&self.plan.cells[cell].config, episodes), timesteps);
                tracked.saved_before.get_or_insert(saved);
                if saved > tracked.saved {
                    (tracked.saved, tracked.attempts) = (saved, 0);
                }
            }
            event if event.is_last() && !self.settled(cell) => self.on_exit(cell, event, now)?,
            _ => {}
        }
        Ok(())
    }

    /// Handles an attempt at a cell that ended without a result: the cell waits for another attempt, fails, or ends the
    /// run.
    fn on_exit(&mut self, cell: usize, end: CellEvent, now: Instant) -> Result<()> {
        let tracked = &mut self.cells[cell];
        match end {
            CellEvent::Busy => tracked.phase = CellPhase::LockedByOther,
            CellEvent::Refused { reason } => return Err(RunError::Refused(reason)),
            CellEvent::Failed { reason } => self.record_failure(cell, reason)?,
            CellEvent::LostServer { .. } => {
                // If this attempt had a server for long enough, successive losses are counted from 0 again.
                if tracked.served.is_some_and(|since| now - since >= STABLE_CONNECTION) {
                    (tracked.lost_in_a_row, tracked.waited) = (0, Duration::ZERO);
                }
                tracked.lost_in_a_row += 1;
                tracked.lost_servers += 1;
                let pause = pause(tracked.lost_in_a_row);
                tracked.waited += pause;
                let (waited, most) = (tracked.waited, self.server_wait.max(MIN_SERVER_WAIT));
                if waited > most {
                    return Err(RunError::NoServer(format!("{}: {end}", self.id(cell))));
                } else if self.paused_until.is_none_or(|until| until < now) {
                    let wait = duration((most + pause - waited).as_secs_f64());
                    let words = format!("{}: {end}; waiting for a server for at most {wait}", self.id(cell));
                    (self.report)(ProgressEvent::Note(&words));
                }
                self.pause(cell, now + pause);
            }
            CellEvent::FileFault { .. } => {
                // If this attempt saved a checkpoint, successive faults are counted from 0 again.
                if tracked.saved_before.is_some_and(|before| tracked.saved > before) {
                    tracked.faults_in_a_row = 0;
                }
                tracked.faults_in_a_row += 1;
                let pause = pause(tracked.faults_in_a_row);
                if tracked.faults_in_a_row >= MAX_FAULTS {
                    return Err(RunError::FileFault(format!("{}: {end}", self.id(cell))));
                }
                self.pause(cell, now + pause);
            }
            end => {
                // Handles any other end, such as a crash. If the attempt saved no checkpoint, the next attempt runs the
                // cell alone.
                tracked.attempts += 1;
                tracked.alone = tracked.saved_before.is_none_or(|before| tracked.saved <= before);
                if tracked.attempts < MAX_ATTEMPTS {
                    self.wait(cell);
                } else if self.backend.records_crashes_as_failures() {
                    let times = format!("{MAX_ATTEMPTS} attempts in a row made no progress");
                    self.record_failure(cell, format!("{end}; {times}"))?;
                } else {
                    tracked.phase = CellPhase::GivenUp;
                    let id = self.id(cell);
                    let note = format!("{id} is given up: {MAX_ATTEMPTS} attempts made no progress");
                    (self.report)(ProgressEvent::Note(&note));
                }
            }
        }
        Ok(())
    }

    /// Stops starting cells until the time `until`, and puts this cell first in the queue. The same cell is then tried
    /// until it succeeds or ends the run, so a persistent fault ends the run soon, even with many cells.
    fn pause(&mut self, cell: usize, until: Instant) {
        self.paused_until = self.paused_until.max(Some(until));
        self.cells[cell].phase = CellPhase::Waiting;
        self.queue.push_front(cell);
    }

    /// Records a cell's failure, because its worker ended without recording it.
    fn record_failure(&mut self, cell: usize, reason: String) -> Result<()> {
        let place = self.folder.cell(self.id(cell));
        let Some(_lock) = place.try_lock()? else {
            self.cells[cell].phase = CellPhase::LockedByOther;
            return Ok(());
        };
        if !self.settled(cell) {
            place.write_failure(&FailureRecord {
                id: self.id(cell).to_owned(),
                reason,
                commit: crate::VERSION.into(),
                requires_restart: false,
            })?;
            self.cells[cell].phase = CellPhase::Failed;
        }
        Ok(())
    }

    /// Returns whether a cell has a result, or a failure that is not retried. Updates the cell's phase.
    fn settled(&mut self, cell: usize) -> bool {
        let Tracked { phase, retryable, .. } = &mut self.cells[cell];
        let place = self.folder.cell(&self.plan.cells[cell].id);
        if matches!(phase, CellPhase::Done | CellPhase::Failed) {
            return true;
        } else if place.is_settled(false) {
            *phase = CellPhase::Done;
            if let Some(timing) = place.timing() {
                self.durations.add(&self.plan.cells[cell], timing.seconds);
            }
            // A result that cannot be read is skipped here. `perturb report` shows the error.
            if let Ok(CellState::Done(result)) = place.state() {
                self.rates.add(&self.plan.cells[cell], &result);
            }
        } else if place.failure_id().is_some_and(|failure| Some(failure) != *retryable) {
            *phase = CellPhase::Failed;
        }
        matches!(phase, CellPhase::Done | CellPhase::Failed)
    }

    /// Looks for results in the folder. If another process no longer works on a cell and has left no result, the cell
    /// waits for a new attempt.
    fn poll_results(&mut self, now: Instant) -> Result<()> {
        let begun = Instant::now();
        let waits = self.backend.reports_ends();
        for cell in 0..self.cells.len() {
            let Tracked { phase, begun, .. } = self.cells[cell];
            // A worker of this run writes a result first and reports it later. So a cell of such a worker is skipped
            // here, and its report is awaited.
            let awaits_report = waits && phase == CellPhase::Running && begun.is_some();
            if !awaits_report
                && !self.settled(cell)
                && self.cells[cell].phase == CellPhase::LockedByOther
                && self.folder.cell(self.id(cell)).try_lock()?.is_some()
            {
                self.wait(cell);
            }
        }
        // Reads at most a twentieth of the time, even with many cells on a slow file system.
        self.next_poll = Some(now + POLL_INTERVAL.max(begun.elapsed() * 20));
        Ok(())
    }

    /// Offers waiting cells to the backend in groups, at most as many groups as it has free slots. Starts nothing
    /// during a pause.
    fn begin(&mut self, now: Instant) -> Result<()> {
        let room = self.backend.free_slots();
        if self.paused_until.is_some_and(|end| now < end) {
            return Ok(());
        }
        let mut offers: Vec<Vec<PendingCell>> = Vec::new();
        let mut places: HashMap<usize, usize> = HashMap::new();
        // Cells of the same group are offered together, except cells that must run alone.
        for cell in self.queue.clone() {
            let Tracked { retryable: retry, group, alone, lost_servers, .. } = self.cells[cell];
            let place = places.get(&group).copied().filter(|_| !alone);
            // Another run may have finished the cell since it was queued.
            if (place.is_none() && offers.len() >= room) || self.settled(cell) {
                continue;
            }
            let seconds = self.durations.seconds(&self.plan.cells[cell]);
            let offer = PendingCell { cell, retry, group, lost_servers, seconds };
            match place {
                Some(place) => offers[place].push(offer),
                None => {
                    if !alone {
                        places.insert(group, offers.len());
                    }
                    offers.push(vec![offer]);
                }
            }
        }
        offers.iter_mut().for_each(|group| group.sort_by_key(|offer| offer.cell));
        if !offers.is_empty() {
            // The backend returns the cells that it has started; the others stay in the queue.
            for cell in self.backend.begin(&offers)? {
                let tracked = &mut self.cells[cell];
                tracked.phase = CellPhase::Running;
                (tracked.begun, tracked.served, tracked.last, tracked.saved_before) = (None, None, None, None);
                tracked.progress = TrainingProgress::default();
            }
        }
        self.queue.retain(|&cell| self.cells[cell].phase == CellPhase::Waiting);
        Ok(())
    }

    /// Puts a cell at the end of the queue.
    fn wait(&mut self, cell: usize) {
        self.cells[cell].phase = CellPhase::Waiting;
        self.queue.push_back(cell);
    }

    /// Returns the ids of the failed cells if all cells are settled, otherwise `None`. Returns [`RunError::GaveUp`] if
    /// all cells are settled or given up, and at least one is given up.
    fn end(&self) -> Result<Option<Vec<String>>> {
        let in_phase = |phase| (0..self.cells.len()).filter(move |&cell| self.cells[cell].phase == phase);
        let left = [CellPhase::Waiting, CellPhase::Running, CellPhase::LockedByOther];
        if left.into_iter().flat_map(in_phase).next().is_some() {
            return Ok(None);
        }
        let ids = |phase| in_phase(phase).map(|cell| self.id(cell).to_owned()).collect();
        let Some(first) = in_phase(CellPhase::GivenUp).next() else { return Ok(Some(ids(CellPhase::Failed))) };
        let words = self.cells[first].last.as_ref().map(CellEvent::to_string).unwrap_or_default();
        Err(RunError::GaveUp { ids: ids(CellPhase::GivenUp), words })
    }

    /// Returns the current status of the run, for display.
    fn status(&self, now: Instant) -> RunStatus {
        let (doing, at_a_time) = self.backend.load();
        let number = |phase| self.cells.iter().filter(|cell| cell.phase == phase).count();
        let (mut running, mut left) = (Running::default(), Vec::new());
        for (place, (tracked, cell)) in self.cells.iter().zip(&self.plan.cells).enumerate() {
            let max_seconds = self.backend.max_seconds(place);
            match (tracked.phase, &tracked.last, tracked.begun) {
                (CellPhase::Running, Some(event), Some(begun)) => {
                    running.add(cell, (!tracked.alone).then_some(tracked.group), event);
                    let rest = rest(cell, event, &tracked.progress);
                    let elapsed_seconds = Some((now - begun).as_secs_f64());
                    left.push(UnfinishedCell { cell, elapsed_seconds, remaining_ratio: rest, max_seconds });
                }
                (CellPhase::Waiting | CellPhase::Running, ..) => {
                    left.push(UnfinishedCell { cell, elapsed_seconds: None, remaining_ratio: None, max_seconds });
                }
                _ => {}
            }
        }
        RunStatus {
            cells: self.cells.len(),
            done: number(CellPhase::Done),
            failed: number(CellPhase::Failed),
            running: running.groups,
            doing,
            remaining: remaining_time(&self.durations, &left, at_a_time),
            rates: self.rates.list(),
        }
    }

    fn id(&self, cell: usize) -> &'a str {
        &self.plan.cells[cell].id
    }
}

/// Returns the pause after `in_a_row` successive attempts that all lost their server, or all could not read or write a
/// file.
fn pause(in_a_row: u32) -> Duration {
    MAX_PAUSE.min(FIRST_PAUSE * (1 << (in_a_row - 1).min(16)))
}

/// Returns the remaining work of a running cell divided by the work that the current attempt has done so far. `event`
/// is the cell's last event. Returns `None` if there is no estimate yet.
fn rest(cell: &Cell, event: &CellEvent, progress: &TrainingProgress) -> Option<f64> {
    let training = generated_episodes(&cell.config, cell.config.common.episodes);
    let testing = test_episodes(cell, None);
    match event {
        CellEvent::Training { .. } => progress.remaining_ratio(training + TEST_SHARE * testing),
        CellEvent::Testing { set, episodes } => {
            let tested = test_episodes(cell, Some(set)) + *episodes as f64;
            let done = (training - progress.first_episodes()).max(0.0) + TEST_SHARE * tested; // in this attempt
            (done > 0.0).then(|| TEST_SHARE * (testing - tested).max(0.0) / done)
        }
        _ => None,
    }
}

/// Returns the number of test episodes of a cell. If `before` is the name of a test, counts only the tests before it.
fn test_episodes(cell: &Cell, before: Option<&str>) -> f64 {
    let Tests { episodes, sets, selection, marks, .. } = &cell.tests;
    let of_mark = marks.iter().map(|mark| format!(" after {mark} episodes"));
    let names =
        of_mark.chain([String::new()]).flat_map(|when| sets.iter().map(move |set| format!("{}{when}", set.name)));
    let mut names = names.chain(selection.map(|_| SELECTION_TEST.to_owned()));
    let tests = names.position(|name| Some(name.as_str()) == before);
    match tests {
        Some(tests) => tests as f64 * *episodes as f64,
        None => ((1 + marks.len()) * sets.len()) as f64 * *episodes as f64 + selection.unwrap_or_default() as f64,
    }
}

#[cfg(test)]
mod tests;
