//! Submitting what is missing and watching until nothing is.

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;
use std::rc::Rc;
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::super::folder::Folder;
use super::super::plan::Plan;
use super::super::run::Times;
use super::batch::{JOB_SECONDS, Load, Size, batches};
use super::commands::{QueuedJob, Slurm};
use super::error::{AnyError, SlurmError};
use super::options::SlurmOptions;
use super::script::script;
use super::submission::{self, Submission};
use crate::files::{self, Lock};
use crate::interrupt::StopFlag;

/// How often a cell may be submitted without getting any further.
pub(super) const MOST_ATTEMPTS: u32 = 3;
/// How long this process sleeps at a time.
const TICK: Duration = Duration::from_millis(20);

/// How far the cells are.
#[derive(Clone, Debug, Default)]
pub struct SlurmStatus {
    /// Cells of the plan.
    pub cells: usize,
    /// Cells with a result.
    pub done: usize,
    /// Cells that failed.
    pub failed: usize,
    /// Jobs that run.
    pub running: usize,
    /// Nodes that they run on.
    pub nodes: usize,
    /// Jobs that wait.
    pub waiting: usize,
    /// Why the first of them waits, in Slurm's word; empty if it does not say.
    pub reason: String,
    /// How long it may take, by what finished cells took; `None` while nothing is known.
    pub remaining: Option<Duration>,
}

/// What is said while jobs are watched.
#[derive(Clone, Debug)]
pub enum Event {
    /// How far it is.
    Status(SlurmStatus),
    /// Something happened: a sentence.
    Note(String),
}

/// How watching ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SlurmEnd {
    /// All cells have a result or have failed; these have failed.
    Finished {
        /// Ids.
        failed: Vec<String>,
    },
    /// This signal ended it, and these arrays go on.
    Stopped {
        /// Its number.
        signal: i32,
        /// Numbers of arrays.
        arrays: Vec<String>,
    },
}

type Result<T> = std::result::Result<T, SlurmError>;

/// Submits the cells of `plan` that neither have a result in `folder` nor are in Slurm's queue, watches until all have
/// one, and submits again what Slurm lost. `costs` gives, by a cell's index, the seconds it may take; it is called once
/// at most, when something is to be submitted. `report` is called now and then.
///
/// # Errors
/// [`SlurmError`]. Jobs that are in the queue stay there.
pub fn run_on_slurm(
    plan: &Plan,
    folder: &Folder,
    slurm: &Slurm,
    options: &SlurmOptions,
    costs: &dyn Fn() -> std::result::Result<Vec<f64>, AnyError>,
    stop: &StopFlag,
    report: &mut dyn FnMut(Event),
) -> Result<SlurmEnd> {
    options.check(folder.path())?;
    let mut watch = Watch {
        plan,
        folder,
        slurm,
        options,
        costs,
        known_costs: None,
        report,
        unsettled: (0..plan.cells.len()).collect(),
        done: 0,
        failed: Vec::new(),
        times: Times::default(),
        submissions: Vec::new(),
        queue: Vec::new(),
        watched: HashSet::new(),
        suspects: HashSet::new(),
        attempts: HashMap::new(),
        given_up: Vec::new(),
        trouble: None,
    };
    let ended = watch.run(stop);
    match (ended, stop.signal()) {
        // A command that was broken off.
        (Err(SlurmError::Silent { .. } | SlurmError::Cost(_)), Some(signal)) => Ok(watch.stopped(signal)),
        (ended, _) => ended,
    }
}

/// Of a cell that was submitted.
struct Attempt {
    count: u32,
    /// All cells of its job: one that had no turn is not to blame.
    job: Rc<[usize]>,
    /// How far they were.
    before: Advance,
}

/// Cells with a result, then steps of trainings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
struct Advance(usize, u64);

struct Watch<'a> {
    plan: &'a Plan,
    folder: &'a Folder,
    slurm: &'a Slurm,
    options: &'a SlurmOptions,
    costs: &'a dyn Fn() -> std::result::Result<Vec<f64>, AnyError>,
    known_costs: Option<Vec<f64>>,
    report: &'a mut dyn FnMut(Event),
    /// Cells that have neither a result nor failed.
    unsettled: Vec<usize>,
    done: usize,
    failed: Vec<usize>,
    times: Times<'a>,
    submissions: Vec<Submission>,
    /// Slurm's last answer.
    queue: Vec<QueuedJob>,
    /// Submissions that this process has seen in the queue.
    watched: HashSet<u32>,
    /// Cells that Slurm's last answer did not have.
    suspects: HashSet<usize>,
    attempts: HashMap<usize, Attempt>,
    given_up: Vec<usize>,
    /// Why Slurm cannot be asked, or takes nothing.
    trouble: Option<String>,
}

impl Watch<'_> {
    fn run(&mut self, stop: &StopFlag) -> Result<SlurmEnd> {
        if self.options.retry_failed {
            self.forget_failures()?;
        }
        let (mut look_at, mut ask_at) = (Instant::now(), Instant::now());
        let mut asked = false;
        loop {
            if let Some(signal) = stop.signal() {
                return Ok(self.stopped(signal));
            }
            let now = Instant::now();
            if now >= look_at {
                self.look();
                // A folder of many cells on a slow file system is not looked at all the time.
                look_at = Instant::now() + self.options.folder_interval.max(now.elapsed() * 20);
                if self.unsettled.len() == self.given_up.len() {
                    return self.finish();
                }
                self.say_status();
            }
            if now >= ask_at {
                match self.ask(stop) {
                    Ok(()) => self.decide(stop)?,
                    Err(error) if asked && stop.signal().is_none() => self.bear(&error),
                    Err(error) => return Err(error),
                }
                asked = true;
                ask_at = Instant::now() + self.options.queue_interval;
                look_at = Instant::now();
            }
            std::thread::sleep(TICK);
        }
    }

    fn stopped(&self, signal: i32) -> SlurmEnd {
        SlurmEnd::Stopped { signal, arrays: self.live_arrays() }
    }

    fn finish(&mut self) -> Result<SlurmEnd> {
        if let Some(&first) = self.given_up.first() {
            let words = self.last_words(first);
            return Err(SlurmError::GaveUp { ids: self.ids(&self.given_up), words });
        }
        self.failed.sort_unstable();
        Ok(SlurmEnd::Finished { failed: self.ids(&self.failed) })
    }

    /// Takes note of the cells that were done or failed meanwhile.
    fn look(&mut self) {
        let (plan, folder) = (self.plan, self.folder);
        let mut unsettled = std::mem::take(&mut self.unsettled);
        unsettled.retain(|&cell| {
            let place = folder.cell(&plan.cells[cell].id);
            if place.is_settled(false) {
                self.done += 1;
                if let Some(timing) = place.timing() {
                    self.times.add(&plan.cells[cell], timing.seconds);
                }
                return false;
            }
            if place.is_settled(true) {
                self.failed.push(cell);
                return false;
            }
            true
        });
        self.given_up.retain(|cell| unsettled.binary_search(cell).is_ok());
        self.unsettled = unsettled;
    }

    /// Makes cells that failed earlier missing ones, as they would be if they had never been tried.
    fn forget_failures(&self) -> Result<()> {
        for cell in &self.plan.cells {
            let place = self.folder.cell(&cell.id);
            if place.is_settled(false) || !place.is_settled(true) {
                continue;
            }
            let Some(_lock) = place.try_lock()? else { continue };
            files::delete(&place.training())?;
            place.forget_failure()?;
        }
        Ok(())
    }

    /// Asks Slurm for the jobs of this folder that may matter still.
    fn ask(&mut self, stop: &StopFlag) -> Result<()> {
        let ids: HashSet<&str> = self.unsettled.iter().map(|&cell| self.plan.cells[cell].id.as_str()).collect();
        let mut submissions = submission::list(self.folder)?;
        submissions.retain(|submission| submission.jobs.iter().flatten().any(|id| ids.contains(id.as_str())));
        let names: Vec<&str> = submissions.iter().map(|submission| submission.names.name.as_str()).collect();
        let mut jobs = self.slurm.queue(&names, stop)?;
        // A folder that was deleted and made again has names that were used before.
        jobs.retain(|job| submissions.iter().any(|submission| belongs(job, submission)));
        self.queue = jobs;
        self.submissions = submissions;
        self.trouble = None;
        Ok(())
    }

    /// Goes on without an answer.
    fn bear(&mut self, error: &SlurmError) {
        let words = error.to_string();
        if self.trouble.as_ref() != Some(&words) {
            self.note(format!("{words}; results are still looked for, and it is tried again"));
            self.trouble = Some(words);
        }
    }

    /// Submits what is neither done nor in the queue. What has been in the queue must be missing from two answers in
    /// succession: a result may be seen here a little later than the end of its job.
    fn decide(&mut self, stop: &StopFlag) -> Result<()> {
        let Some(_lock) = self.lock()? else { return Ok(()) }; // another process decides
        self.adopt()?;
        self.look(); // after Slurm's answer: a job that has ended has written what it had
        let mut queued: HashSet<&str> = HashSet::new();
        for job in self.queue.iter().filter(|job| job.is_live()) {
            let of = self.submissions.iter().find(|submission| belongs(job, submission));
            let cells = of.and_then(|submission| submission.jobs.get(job.index));
            queued.extend(cells.into_iter().flatten().map(String::as_str));
        }
        // Read again: since Slurm was asked, another process may have submitted.
        let submissions = submission::list(self.folder)?;
        let submitted: HashSet<&str> =
            submissions.iter().flat_map(|submission| submission.jobs.iter().flatten()).map(String::as_str).collect();
        let id = |cell: usize| self.plan.cells[cell].id.as_str();
        let missing: Vec<usize> = self
            .unsettled
            .iter()
            .copied()
            .filter(|&cell| !queued.contains(id(cell)) && !self.given_up.contains(&cell))
            .collect();
        let left: HashSet<usize> = missing.iter().copied().filter(|&cell| submitted.contains(id(cell))).collect();
        let sure = left.is_subset(&self.suspects);
        self.suspects = left;
        if missing.is_empty() || !sure {
            return Ok(());
        }
        self.say_lost()?;
        self.submit(&missing, stop)
    }

    /// Takes note of the arrays in the queue, and of numbers that were never heard.
    fn adopt(&mut self) -> Result<()> {
        let mut notes = Vec::new();
        for submission in &mut self.submissions {
            let jobs: Vec<&QueuedJob> =
                self.queue.iter().filter(|job| job.is_live() && belongs(job, submission)).collect();
            let Some(first) = jobs.first() else { continue };
            if submission.names.job.is_none() {
                submission.accepted(&first.array)?;
            }
            if self.watched.insert(submission.number) {
                notes.push(format!("Slurm job {} is in the queue, with {}", first.array, count(jobs.len(), "job")));
            }
        }
        notes.into_iter().for_each(|note| self.note(note));
        Ok(())
    }

    /// Says which cells were lost, and how. If somebody cancelled everything, that was meant.
    fn say_lost(&mut self) -> Result<()> {
        let mut lost: Vec<usize> = self.suspects.iter().copied().collect();
        lost.sort_unstable();
        let ends: Vec<Option<(&Submission, usize, String)>> = lost.iter().map(|&cell| self.end_of(cell)).collect();
        let cancelled = |end: &Option<(&Submission, usize, String)>| {
            end.as_ref()
                .is_some_and(|(submission, _, state)| state == "CANCELLED" && self.watched.contains(&submission.number))
        };
        if !lost.is_empty() && self.live_arrays().is_empty() && ends.iter().all(cancelled) {
            let numbers = ends.iter().flatten().filter_map(|(submission, ..)| submission.names.job.clone());
            let arrays = super::super::plan::distinct(numbers);
            return Err(SlurmError::Cancelled { arrays, missing: lost.len() });
        }
        let mut how: Vec<String> = Vec::new();
        for (submission, index, state) in ends.iter().flatten() {
            let array = submission.names.job.as_deref().unwrap_or(&submission.names.name);
            let text = format!("{array}_{index} {state}");
            if !how.contains(&text) {
                how.push(text);
            }
        }
        if how.len() > 5 {
            how.truncate(4);
            how.push("and others".into());
        }
        if !lost.is_empty() {
            let how = how.join(", ");
            self.note(format!("{} left Slurm's queue without a result ({how})", count(lost.len(), "cell")));
        }
        Ok(())
    }

    /// The last job that had a cell, its index, and the state that it ended in.
    fn end_of(&self, cell: usize) -> Option<(&Submission, usize, String)> {
        let id = &self.plan.cells[cell].id;
        let place = |submission: &Submission| submission.jobs.iter().position(|job| job.contains(id));
        let (submission, index) =
            self.submissions.iter().rev().find_map(|submission| Some((submission, place(submission)?)))?;
        let job = self.queue.iter().find(|job| job.index == index && belongs(job, submission));
        Some((submission, index, job.map_or_else(|| "gone".into(), |job| job.state.clone())))
    }

    /// Submits `cells`, without those that were submitted too often.
    fn submit(&mut self, cells: &[usize], stop: &StopFlag) -> Result<()> {
        let mut wanted = Vec::new();
        for &cell in cells {
            let advance = self.attempts.get(&cell).map(|attempt| (self.advance(&attempt.job), attempt.before));
            let Some(attempt) = self.attempts.get_mut(&cell) else {
                wanted.push(cell);
                continue;
            };
            if advance.is_some_and(|(now, before)| now > before) {
                attempt.count = 0;
            }
            if attempt.count < MOST_ATTEMPTS {
                wanted.push(cell);
                continue;
            }
            self.given_up.push(cell);
            let id = &self.plan.cells[cell].id;
            self.note(format!(
                "{id} is given up: its jobs ended {MOST_ATTEMPTS} times without bringing it any further"
            ));
        }
        if wanted.is_empty() {
            return Ok(());
        }
        let most_jobs = match self.slurm.most_jobs(stop) {
            Ok(number) => number,
            Err(error) => return self.put_off(error),
        };
        let jobs = self.batches(&wanted, most_jobs)?;
        let before: Vec<Advance> = jobs.iter().map(|job| self.advance(job)).collect();
        let ids = jobs.iter().map(|job| self.ids(job)).collect();
        let text = |path: &std::path::Path| Ok(script(&self.options.task, self.folder.path(), path)?);
        let mut submission = submission::create(self.folder, &self.plan.text, ids, &text)?;
        let array = match self.slurm.submit(&submission, self.options) {
            Ok(array) => array,
            Err(error @ (SlurmError::Refused { .. } | SlurmError::NotInstalled { .. } | SlurmError::Option(_))) => {
                submission.forget()?; // nothing was accepted
                return self.put_off(error);
            }
            Err(error) => return Err(error),
        };
        submission.accepted(&array)?;
        let most = jobs.iter().map(Vec::len).max().unwrap_or_default();
        let number = jobs.iter().map(Vec::len).sum();
        self.note(format!(
            "submitted {} as Slurm job {array}: {} of at most {}",
            count(number, "cell"),
            count(jobs.len(), "job"),
            count(most, "cell")
        ));
        for (index, (job, before)) in jobs.into_iter().zip(before).enumerate() {
            let job: Rc<[usize]> = job.into();
            for &cell in job.iter() {
                let count = self.attempts.get(&cell).map_or(0, |attempt| attempt.count) + 1;
                self.attempts.insert(cell, Attempt { count, job: job.clone(), before });
                self.suspects.remove(&cell);
            }
            let [state, reason, node] = ["PENDING", "", ""].map(str::to_owned);
            let name = submission.names.name.clone();
            self.queue.push(QueuedJob { array: array.clone(), index, state, reason, node, name });
        }
        self.watched.insert(submission.number);
        self.submissions.push(submission);
        Ok(())
    }

    /// While jobs are in the queue, a refusal may be for their sake: limits on how many there are.
    fn put_off(&mut self, error: SlurmError) -> Result<()> {
        if self.live_arrays().is_empty() {
            return Err(error);
        }
        self.bear(&error);
        Ok(())
    }

    fn batches(&mut self, cells: &[usize], most_jobs: usize) -> Result<Vec<Vec<usize>>> {
        let options = self.options;
        let seconds: Vec<f64> = match options.cells_per_job {
            Some(_) => vec![0.0; cells.len()],
            None => self.seconds(cells)?,
        };
        let alone = |cell: &usize| self.attempts.get(cell).is_some_and(|attempt| attempt.count > 0);
        let loads: Vec<Load> = cells
            .iter()
            .zip(seconds)
            .map(|(cell, seconds)| Load { cell: *cell, seconds, alone: alone(cell) })
            .collect();
        let limit = options.time.as_ref().map_or(f64::INFINITY, |limit| limit.seconds() as f64 / 2.0);
        let size = match options.cells_per_job {
            Some(number) => Size::Cells(number),
            None => Size::Seconds(JOB_SECONDS.min(limit) * options.task.jobs as f64),
        };
        Ok(batches(&loads, size, most_jobs))
    }

    /// How long each of `cells` may take: as long as others of its kind took, or as measured.
    fn seconds(&mut self, cells: &[usize]) -> Result<Vec<f64>> {
        let taken = |watch: &Self, cell: usize| watch.times.of_pair(&watch.plan.cells[cell]);
        if self.known_costs.is_none() && cells.iter().any(|&cell| taken(self, cell).is_none()) {
            self.known_costs = Some((self.costs)().map_err(SlurmError::Cost)?);
        }
        let known = self.known_costs.as_deref().unwrap_or_default();
        let of = |&cell: &usize| taken(self, cell).or_else(|| known.get(cell).copied()).unwrap_or_default();
        Ok(cells.iter().map(of).collect())
    }

    fn advance(&self, cells: &[usize]) -> Advance {
        let of = |cell: &usize| {
            let place = self.folder.cell(&self.plan.cells[*cell].id);
            let settled = usize::from(place.is_settled(true));
            Advance(settled, trained_steps(place.training().join("checkpoint").join("checkpoint.json")))
        };
        cells.iter().map(of).fold(Advance::default(), |sum, one| Advance(sum.0 + one.0, sum.1 + one.1))
    }

    /// How the last job of a cell ended, and what it said last.
    fn last_words(&self, cell: usize) -> String {
        let Some((submission, index, state)) = self.end_of(cell) else { return "nothing is known of its job".into() };
        let log = submission.log(index);
        let array = submission.names.job.as_deref().unwrap_or_default();
        let text = std::fs::read_to_string(&log).unwrap_or_default();
        match text.lines().rev().find(|line| !line.trim().is_empty()) {
            Some(line) => format!("Slurm job {array}_{index} ({state}) said `{line}`, see {}", log.display()),
            None => format!(
                "Slurm job {array}_{index} ({state}) wrote nothing to {}: do the nodes see this folder?",
                log.display()
            ),
        }
    }

    /// Only one process decides at a time; `None` while another one does.
    fn lock(&self) -> files::Result<Option<Lock>> {
        let directory = submission::directory(self.folder);
        files::create_folder(&directory)?;
        Lock::try_take(&directory.join("lock"))
    }

    fn live_arrays(&self) -> Vec<String> {
        let live = self.queue.iter().filter(|job| job.is_live());
        super::super::plan::distinct(live.map(|job| job.array.clone()))
    }

    fn ids(&self, cells: &[usize]) -> Vec<String> {
        cells.iter().map(|&cell| self.plan.cells[cell].id.clone()).collect()
    }

    fn note(&mut self, text: String) {
        (self.report)(Event::Note(text));
    }

    fn say_status(&mut self) {
        let live = || self.queue.iter().filter(|job| job.is_live());
        let running: Vec<&QueuedJob> = live().filter(|job| !job.node.is_empty()).collect();
        let waiting: Vec<&QueuedJob> = live().filter(|job| job.node.is_empty()).collect();
        let nodes: HashSet<&str> = running.iter().map(|job| job.node.as_str()).collect();
        let left = self.unsettled.iter().map(|&cell| (&self.plan.cells[cell], 0.0));
        let at_a_time = running.len().max(1) * self.options.task.jobs;
        let reasons = waiting.iter().map(|job| job.reason.as_str());
        let reason = reasons.into_iter().find(|reason| !["", "None", "(null)"].contains(reason)).unwrap_or_default();
        let status = SlurmStatus {
            cells: self.plan.cells.len(),
            done: self.done,
            failed: self.failed.len(),
            running: running.len(),
            nodes: nodes.len(),
            waiting: waiting.len(),
            reason: reason.to_owned(),
            remaining: self.times.remaining(left, at_a_time),
        };
        (self.report)(Event::Status(status));
    }
}

/// Whether squeue's `job` is of the array of `submission`.
fn belongs(job: &QueuedJob, submission: &Submission) -> bool {
    let names = &submission.names;
    job.name == names.name && names.job.as_ref().is_none_or(|array| *array == job.array)
}

/// How far a training is, by its last checkpoint.
fn trained_steps(checkpoint: PathBuf) -> u64 {
    #[derive(Deserialize)]
    struct Counters {
        timesteps: u64,
    }
    #[derive(Deserialize)]
    struct Document {
        counters: Counters,
    }
    let text = std::fs::read(checkpoint).unwrap_or_default();
    serde_json::from_slice::<Document>(&text).map_or(0, |document| document.counters.timesteps)
}

/// "1 cell", "2 cells".
pub fn count(number: usize, noun: &str) -> String {
    if number == 1 { format!("1 {noun}") } else { format!("{number} {noun}s") }
}
