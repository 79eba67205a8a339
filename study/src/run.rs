//! Doing all cells of a plan, each in a process of its own.
//!
//! A worker process does one cell and takes its lock itself, so that several runs may share a folder. It is told to
//! stop by the closing of its standard input, which also happens when this process dies, however it dies.

use std::collections::{HashMap, VecDeque};
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use super::folder::{Failure, FailureMark, Folder, FolderError};
use super::plan::{Cell, Plan};
use crate::Method;
use crate::files::FileError;
use crate::interrupt::StopFlag;

/// A worker's exit status if somebody else works on its cell (EX_TEMPFAIL of sysexits.h).
pub const BUSY: u8 = 75;
/// What a worker's line in its log begins with once it has a server, before its address.
pub const ON: &str = "on ";
/// A worker's exit status if there is no server, or no longer (EX_UNAVAILABLE of sysexits.h).
pub const NO_SERVER: u8 = 69;
/// A worker's exit status if its command makes no sense to it.
const USAGE: i32 = 2;
/// How often a worker may be killed before its cell counts as failed.
const MOST_ATTEMPTS: u32 = 3;
/// How often in a row the worker of a cell may be without a server before the run ends: after some fifteen seconds, in
/// which a server may have been started again.
const MOST_LOSSES: u32 = 5;
/// A worker that had a server and ran for so long made some progress: what is lost then is not lost in a row.
const HAD_A_SERVER: Duration = Duration::from_secs(60);
/// How often it is said how far the run is, which looks at every cell that is left.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// How often workers are looked at.
const TICK: Duration = Duration::from_millis(50);
/// How long no worker is started after one had no server; doubled at each time in a row.
const SERVER_PAUSE: Duration = Duration::from_secs(1);
/// How often cells are looked at that others work on.
const BUSY_INTERVAL: Duration = Duration::from_secs(1);

/// How to run.
pub struct RunOptions<'a> {
    /// Worker processes at a time, at least 1.
    pub jobs: usize,
    /// Whether cells that have failed before are tried again.
    pub retry_failed: bool,
    /// Makes the command of a worker for a cell; its standard input is set here.
    pub worker: &'a dyn Fn(&Cell, Attempt) -> std::io::Result<Command>,
    /// Says what is wrong with the servers; `None` while nothing is known to be.
    pub server_trouble: &'a dyn Fn() -> Option<String>,
}

/// What a worker is told of those before it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Attempt {
    /// The failure that it may forget, and no other.
    pub retry: Option<FailureMark>,
    /// How many servers earlier workers of its cell have lost.
    pub losses: u32,
}

/// How far a run is.
#[derive(Clone, Debug)]
pub struct RunStatus {
    /// Cells of the plan.
    pub cells: usize,
    /// Cells with a result.
    pub done: usize,
    /// Cells that failed.
    pub failed: usize,
    /// What the workers do.
    pub running: Vec<String>,
    /// How long it may take, by what finished cells took; `None` before the first.
    pub remaining: Option<Duration>,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RunEnd {
    /// All cells have a result or have failed; these have failed.
    Finished {
        /// Ids.
        failed: Vec<String>,
    },
    /// This signal ended it. Calling it again goes on.
    Stopped(i32),
}

/// Why a run cannot go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The folder cannot be read or written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The operating system refused a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A worker cannot be started.
    #[error("cannot start a worker process: {0}")]
    Spawn(std::io::Error),
    /// A worker does not know the plan's cells.
    #[error("a worker refused its command: {0}; did another run replace the folder's plan.toml meanwhile?")]
    Refused(String),
    /// The servers are gone.
    #[error("the run cannot go on without a server: {0}; finished cells are kept, call it again to go on")]
    NoServer(String),
}

struct Job {
    cell: usize,
    child: Child,
    start: Instant,
    /// Where its words begin in the cell's log, in bytes.
    log_start: u64,
}

/// How often a cell's worker had no server, or lost it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Losses {
    all: u32,
    in_a_row: u32,
}

impl Losses {
    /// One more, of a worker that had run for `time`.
    fn add(&mut self, time: Duration) {
        self.all += 1;
        self.in_a_row = if time < HAD_A_SERVER { self.in_a_row + 1 } else { 1 };
    }

    /// How long to wait before the next try; `None` if there should be none.
    fn pause(self) -> Option<Duration> {
        (self.in_a_row < MOST_LOSSES).then(|| SERVER_PAUSE * (1 << self.in_a_row.saturating_sub(1)))
    }
}

struct Runner<'a> {
    plan: &'a Plan,
    folder: &'a Folder,
    options: &'a RunOptions<'a>,
    queue: VecDeque<usize>,
    /// Failures that were there before this run and that do not count. One that is recorded later does, whoever tried.
    forgiven: HashMap<usize, FailureMark>,
    /// Cells that others work on.
    elsewhere: Vec<usize>,
    looked_elsewhere: Instant,
    running: Vec<Job>,
    done: usize,
    failed: Vec<usize>,
    attempts: HashMap<usize, u32>,
    lost: HashMap<usize, Losses>,
    paused_until: Option<Instant>,
    times: Times<'a>,
}

/// Does every cell of `plan` that has no result in `folder`, and calls `report` now and then. Returns when no cell is
/// left, also none that another run works on.
///
/// # Errors
/// [`RunError`]; workers have then been stopped.
pub fn run(
    plan: &Plan,
    folder: &Folder,
    options: &RunOptions<'_>,
    stop: &StopFlag,
    report: &mut dyn FnMut(&RunStatus),
) -> Result<RunEnd, RunError> {
    let mut runner = Runner::new(plan, folder, options);
    let ended = runner.run(stop, report);
    runner.stop_workers();
    ended
}

impl<'a> Runner<'a> {
    fn new(plan: &'a Plan, folder: &'a Folder, options: &'a RunOptions<'a>) -> Self {
        let mut runner = Self {
            plan,
            folder,
            options,
            queue: VecDeque::new(),
            forgiven: HashMap::new(),
            elsewhere: Vec::new(),
            looked_elsewhere: Instant::now(),
            running: Vec::new(),
            done: 0,
            failed: Vec::new(),
            attempts: HashMap::new(),
            lost: HashMap::new(),
            paused_until: None,
            times: Times::default(),
        };
        for cell in 0..plan.cells.len() {
            if let Some(failure) = folder.cell(&plan.cells[cell].id).failure_mark().filter(|_| options.retry_failed) {
                runner.forgiven.insert(cell, failure);
            }
            if !runner.settled(cell) {
                runner.queue.push_back(cell);
            }
        }
        runner
    }

    fn run(&mut self, stop: &StopFlag, report: &mut dyn FnMut(&RunStatus)) -> Result<RunEnd, RunError> {
        let mut reported: Option<Instant> = None;
        loop {
            self.reap()?;
            if let Some(signal) = stop.signal() {
                return Ok(RunEnd::Stopped(signal));
            }
            if let Some(trouble) = (self.options.server_trouble)() {
                return Err(RunError::NoServer(trouble));
            }
            self.look_elsewhere()?;
            self.start_workers()?;
            if reported.is_none_or(|time| time.elapsed() >= STATUS_INTERVAL) {
                reported = Some(Instant::now());
                report(&self.status());
            }
            if self.running.is_empty() && self.queue.is_empty() && self.elsewhere.is_empty() {
                let failed = self.failed.iter().map(|&cell| self.plan.cells[cell].id.clone()).collect();
                return Ok(RunEnd::Finished { failed });
            }
            std::thread::sleep(TICK);
        }
    }

    /// Whether a cell has a result, or has failed and that counts; if so, it is counted.
    fn settled(&mut self, cell: usize) -> bool {
        let place = self.folder.cell(&self.plan.cells[cell].id);
        if place.is_settled(false) {
            self.done += 1;
            if let Some(timing) = place.timing() {
                self.times.add(&self.plan.cells[cell], timing.seconds);
            }
            return true;
        }
        let failure = place.failure_mark();
        let failed = failure.is_some() && failure.as_ref() != self.forgiven.get(&cell);
        if failed {
            self.failed.push(cell);
        }
        failed
    }

    fn start_workers(&mut self) -> Result<(), RunError> {
        if self.paused_until.is_some_and(|end| Instant::now() < end) {
            return Ok(());
        }
        while self.running.len() < self.options.jobs {
            let Some(cell) = self.queue.pop_front() else { break };
            // Another run may have done it meanwhile.
            if self.settled(cell) {
                continue;
            }
            let losses = self.lost.get(&cell).copied().unwrap_or_default().all;
            let attempt = Attempt { retry: self.forgiven.get(&cell).copied(), losses };
            let mut command = (self.options.worker)(&self.plan.cells[cell], attempt).map_err(RunError::Spawn)?;
            let log_start = std::fs::metadata(self.log(cell)).map_or(0, |log| log.len());
            let child = command.stdin(Stdio::piped()).spawn().map_err(RunError::Spawn)?;
            self.running.push(Job { cell, child, start: Instant::now(), log_start });
        }
        Ok(())
    }

    /// Takes note of the workers that have ended.
    fn reap(&mut self) -> Result<(), RunError> {
        let mut ended = Vec::new();
        for job in std::mem::take(&mut self.running) {
            let Job { cell, mut child, start, log_start } = job;
            match child.try_wait().map_err(RunError::Spawn)? {
                Some(status) => ended.push((cell, status, start.elapsed(), log_start)),
                None => self.running.push(Job { cell, child, start, log_start }),
            }
        }
        ended.into_iter().try_for_each(|(cell, status, time, log_start)| {
            // Looking for a server, of which many may be silent, is not having one.
            let served = if self.found_a_server(cell, log_start) { time } else { Duration::ZERO };
            self.conclude(cell, status, served)
        })
    }

    /// Whether a cell's worker says so in what it logged from `start` on.
    fn found_a_server(&self, cell: usize, start: u64) -> bool {
        let log = std::fs::read(self.log(cell)).unwrap_or_default();
        let said = log.get(start as usize..).unwrap_or_default();
        String::from_utf8_lossy(said).lines().any(|line| line.starts_with(ON))
    }

    /// What a cell's workers have to say.
    fn log(&self, cell: usize) -> std::path::PathBuf {
        self.folder.cell(&self.plan.cells[cell].id).log()
    }

    /// Takes note of the end of a worker that had a server for `time` at most.
    fn conclude(&mut self, cell: usize, status: ExitStatus, time: Duration) -> Result<(), RunError> {
        if self.settled(cell) {
            return Ok(());
        }
        if status.code() == Some(BUSY.into()) {
            self.elsewhere.push(cell);
            return Ok(());
        }
        if status.code() == Some(NO_SERVER.into()) {
            let losses = self.lost.entry(cell).or_default();
            losses.add(time);
            let Some(pause) = losses.pause() else {
                let id = &self.plan.cells[cell].id;
                return Err(RunError::NoServer(format!("{id}: {}", self.last_words(cell))));
            };
            // At the front: if the servers are gone, the run ends soon, however many cells it has.
            self.queue.push_front(cell);
            self.paused_until = Some(Instant::now() + pause);
            return Ok(());
        }
        if status.code() == Some(USAGE) {
            return Err(RunError::Refused(self.last_words(cell)));
        }
        if let Some(signal) = signal_of(status) {
            let attempts = self.attempts.entry(cell).or_default();
            *attempts += 1;
            let attempts = *attempts;
            if attempts < MOST_ATTEMPTS {
                self.queue.push_back(cell);
                return Ok(());
            }
            return self.record_failure(cell, format!("its process was ended by signal {signal}, {attempts} times"));
        }
        let reason = format!("its process ended with {status}: {}", self.last_words(cell));
        self.record_failure(cell, reason)
    }

    /// Records the failure of a worker that could not do so itself.
    fn record_failure(&mut self, cell: usize, reason: String) -> Result<(), RunError> {
        let id = self.plan.cells[cell].id.clone();
        let place = self.folder.cell(&id);
        let Some(_lock) = place.try_lock()? else {
            self.elsewhere.push(cell);
            return Ok(());
        };
        if !self.settled(cell) {
            place.write_failure(&Failure { id, reason, commit: crate::VERSION.into() })?;
            self.settled(cell);
        }
        Ok(())
    }

    /// The last line of a worker's log.
    fn last_words(&self, cell: usize) -> String {
        let log = self.log(cell);
        let text = std::fs::read_to_string(&log).unwrap_or_default();
        let line = text.lines().rev().find(|line| !line.trim().is_empty());
        line.map_or_else(|| format!("see {}", log.display()), str::to_owned)
    }

    /// Cells that others worked on: done now, or given up.
    fn look_elsewhere(&mut self) -> Result<(), RunError> {
        if self.elsewhere.is_empty() || self.looked_elsewhere.elapsed() < BUSY_INTERVAL {
            return Ok(());
        }
        self.looked_elsewhere = Instant::now();
        for cell in std::mem::take(&mut self.elsewhere) {
            if self.settled(cell) {
                continue;
            }
            match self.folder.cell(&self.plan.cells[cell].id).try_lock()? {
                Some(_free) => self.queue.push_back(cell),
                None => self.elsewhere.push(cell),
            }
        }
        Ok(())
    }

    fn status(&self) -> RunStatus {
        let cell = |index: usize| &self.plan.cells[index];
        let waiting = self.queue.iter().map(|&index| (cell(index), 0.0));
        let running = self.running.iter().map(|job| (cell(job.cell), job.start.elapsed().as_secs_f64()));
        RunStatus {
            cells: self.plan.cells.len(),
            done: self.done,
            failed: self.failed.len(),
            running: self.running.iter().map(|job| cell(job.cell).id.clone()).collect(),
            remaining: self.times.remaining(waiting.chain(running), self.options.jobs),
        }
    }

    /// Asks all workers to stop, and waits for them. They finish their iteration first.
    fn stop_workers(&mut self) {
        for job in &mut self.running {
            drop(job.child.stdin.take());
        }
        for job in &mut self.running {
            let _ = job.child.wait(); // an error means that it has been waited for
        }
        self.running.clear();
    }
}

/// The signal that ended a process, told by the system or by the process itself.
fn signal_of(status: ExitStatus) -> Option<i32> {
    status.signal().or_else(|| status.code().filter(|&code| code > 128).map(|code| code - 128))
}

/// What finished cells took.
#[derive(Default)]
pub(super) struct Times<'a> {
    by_pair: HashMap<(&'a str, Method), Mean>,
    all: Mean,
}

#[derive(Clone, Copy, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, number: f64) {
        self.sum += number;
        self.count += 1.0;
    }

    fn get(self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

impl<'a> Times<'a> {
    pub(super) fn add(&mut self, cell: &'a Cell, seconds: f64) {
        self.by_pair.entry((&cell.config.common.environment, cell.method())).or_default().add(seconds);
        self.all.add(seconds);
    }

    /// What cells of the same environment and method took; `None` before the first.
    pub(super) fn of_pair(&self, cell: &Cell) -> Option<f64> {
        self.by_pair.get(&(cell.config.common.environment.as_str(), cell.method()))?.get()
    }

    /// How long `cells`, which have run for so many seconds each, may still take.
    pub(super) fn remaining<'c>(&self, cells: impl Iterator<Item = (&'c Cell, f64)>, jobs: usize) -> Option<Duration> {
        let overall = self.all.get()?;
        let (mut seconds, mut longest, mut left) = (0.0, 0.0_f64, 0);
        for (cell, spent) in cells {
            let expected = self.of_pair(cell).unwrap_or(overall);
            let rest = (expected - spent).max(0.0);
            seconds += rest;
            longest = longest.max(rest);
            left += 1;
        }
        let jobs = jobs.clamp(1, left.max(1)) as f64;
        Some(Duration::from_secs_f64((seconds / jobs).max(longest)))
    }
}

#[cfg(test)]
#[path = "run_tests.rs"]
mod tests;
