//! The backend that submits cells as Slurm job arrays and follows their jobs.

use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::time::Instant;

use perturb_files::interrupt::StopFlag;
use perturb_files::{AnyError, Lock, create_folder, io, open_plain};

use perturb_text::shortened;

use super::super::event::{last_log_line, read_lines};
use super::super::{Backend, BackendEvent, CellEvent, PendingCell, Result, RunError, count};
use super::batch::{CellLoad, JOB_SECONDS, JobSize, batches};
use super::commands::{QueueAnswer, Slurm};
use super::error::SlurmError;
use super::job::QueuedJob;
use super::options::SlurmOptions;
use super::script::script;
use super::submission::{self, Submission};
use crate::folder::ExperimentFolder;
use crate::plan::{Grouping, Plan, distinct};

/// Maximum number of different non-job lines of squeue that are reported to the user.
const MAX_FOREIGN_LINES: usize = 10;

/// A [`Backend`] that runs cells as jobs of Slurm. Jobs stay in Slurm's queue when this process ends. A later process
/// with the same folder finds them again.
pub struct Jobs<'a> {
    plan: &'a Plan,
    folder: &'a ExperimentFolder,
    slurm: &'a Slurm,
    options: &'a SlurmOptions,
    costs: &'a dyn Fn() -> Result<Vec<f64>, AnyError>,
    known_costs: Option<Vec<f64>>,
    stop: &'a StopFlag,
    /// Index in the plan by cell id.
    places: HashMap<&'a str, usize>,
    submissions: Vec<Submission>,
    /// The last job of each cell: index in `submissions`, and index in the job array.
    last: HashMap<usize, (usize, usize)>,
    /// The jobs in Slurm's last answer.
    queue: Vec<QueuedJob>,
    /// Number of Slurm's answers so far.
    answers: u32,
    /// Read positions in the jobs' event files, by number of the submission and index of the job.
    cursors: HashMap<(u32, usize), LogCursor>,
    /// Numbers of the submissions that this process has seen in the queue.
    watched: HashSet<u32>,
    /// Cells that this backend has accepted from the scheduler and not handed back.
    taken: HashSet<usize>,
    /// Cells in `taken` that had no job in Slurm's last answer.
    suspects: HashSet<usize>,
    /// Lock that lets only one process at a time decide what to submit. It is held from the request for the queue until
    /// the submission.
    deciding: Option<Lock>,
    ask_at: Option<Instant>,
    /// Non-job lines of squeue that have already been reported to the user.
    foreign: HashSet<String>,
    /// The last reported reason why Slurm does not answer or does not accept jobs; `None` after an answer.
    trouble: Option<String>,
    /// Events for the next call of `poll`.
    pending_events: Vec<BackendEvent>,
}

/// Read position in the event file of a job (bytes), and the cells that the job has started according to its events.
#[derive(Default)]
struct LogCursor {
    offset: u64,
    cells: HashSet<usize>,
}

impl<'a> Jobs<'a> {
    /// Returns the backend for `plan` in `folder`. `costs` estimates the duration of each cell, in seconds by index in
    /// the plan. `costs` is called at most once, before the first submission that needs it.
    pub fn new(
        plan: &'a Plan,
        folder: &'a ExperimentFolder,
        slurm: &'a Slurm,
        options: &'a SlurmOptions,
        costs: &'a dyn Fn() -> Result<Vec<f64>, AnyError>,
        stop: &'a StopFlag,
    ) -> Self {
        Self {
            plan,
            folder,
            slurm,
            options,
            costs,
            known_costs: None,
            stop,
            places: plan.cells.iter().enumerate().map(|(place, cell)| (&*cell.id, place)).collect(),
            submissions: Vec::new(),
            last: HashMap::new(),
            queue: Vec::new(),
            answers: 0,
            cursors: HashMap::new(),
            watched: HashSet::new(),
            taken: HashSet::new(),
            suspects: HashSet::new(),
            deciding: None,
            ask_at: None,
            foreign: HashSet::new(),
            trouble: None,
            pending_events: Vec::new(),
        }
    }

    /// Asks Slurm for the state of all jobs that have unfinished cells of the plan.
    fn ask(&mut self) -> Result<()> {
        let mut submissions = submission::list(self.folder).map_err(SlurmError::from)?;
        let matters = |id: &String| self.places.contains_key(&**id) && !self.folder.cell(id).is_settled(false);
        submissions.retain(|submission| submission.jobs.iter().flatten().any(matters));
        let names: Vec<&str> = submissions.iter().map(|submission| submission.names.name.as_str()).collect();
        let QueueAnswer { jobs, foreign } = self.slurm.queue(&names, self.stop)?;
        self.queue = jobs;
        for line in foreign {
            if self.foreign.len() < MAX_FOREIGN_LINES && self.foreign.insert(line.clone()) {
                let line = shortened(line);
                self.pending_events
                    .push(BackendEvent::Note(format!("squeue printed a line that is not a job, ignored: {line}")));
            }
        }
        // If the folder was deleted and created again, older arrays may have the same names.
        self.queue.retain(|job| submissions.iter().any(|submission| submission.has(job)));
        self.submissions = submissions;
        self.last.clear();
        (0..self.submissions.len()).for_each(|submission| self.remember(submission));
        self.answers += 1;
        self.trouble = None;
        Ok(())
    }

    /// Records each job of a submission as the last job of its cells.
    fn remember(&mut self, submission: usize) {
        for (index, cells) in self.submissions[submission].jobs.iter().enumerate() {
            let cells = cells.iter().filter_map(|id| self.places.get(&**id));
            self.last.extend(cells.map(|&cell| (cell, (submission, index))));
        }
    }

    /// Continues the run despite an error of Slurm. Reports the error to the user once.
    fn report_and_continue(&mut self, error: &RunError) {
        let words = error.to_string();
        if self.trouble.as_ref() != Some(&words) {
            self.pending_events
                .push(BackendEvent::Note(format!("{words}; results are still read, and Slurm is asked again")));
            self.trouble = Some(words);
        }
    }

    /// Reports the arrays that are in the queue. Stores the number of an array if the process that submitted it was
    /// interrupted before it could store the number.
    fn report_queued_arrays(&mut self) -> Result<()> {
        for submission in &mut self.submissions {
            let jobs: Vec<_> = self.queue.iter().filter(|job| job.is_live() && submission.has(job)).collect();
            let Some(first) = jobs.first() else { continue };
            if submission.names.job.is_none() {
                submission.accepted(&first.array)?;
            }
            if self.watched.insert(submission.number) {
                let jobs = count(jobs.len(), "job");
                self.pending_events
                    .push(BackendEvent::Note(format!("Slurm job {} is in the queue, with {jobs}", first.array)));
            }
        }
        Ok(())
    }

    /// Reads the new events of job `index` of a submission.
    fn read(&mut self, submission: usize, index: usize) -> Result<()> {
        let submission = &self.submissions[submission];
        let path = submission.events(index);
        if !path.exists() {
            return Ok(()); // the job has not started
        }
        // Opening the file each time makes a network file system look for new content.
        let (file, _) = open_plain(&path).map_err(io("open", &path))?;
        let cursor = self.cursors.entry((submission.number, index)).or_default();
        for line in read_lines(&file, &mut cursor.offset).map_err(io("read", &path))? {
            let Some(&cell) = self.places.get(&*line.cell) else { continue };
            if line.event.shows_work() {
                cursor.cells.insert(cell);
            }
            // A job repeats failed attempts itself, so the end of an attempt is not reported while the job runs.
            if !line.event.is_last() {
                self.pending_events.push(BackendEvent::Event(cell, line.event));
            }
        }
        Ok(())
    }

    /// Reads the events of running jobs, and hands back the unfinished cells whose jobs have left the queue. A job must
    /// be missing in two successive answers of Slurm, because on a network file system its result may become visible
    /// only some time after its end.
    fn return_lost_cells(&mut self) -> Result<()> {
        let jobs: HashSet<(usize, usize)> = self.taken.iter().filter_map(|cell| self.last.get(cell).copied()).collect();
        for (submission, index) in jobs {
            if let Err(error) = self.read(submission, index) {
                self.report_and_continue(&error);
            }
        }
        let queued = self.queued();
        let lost = |cell: &usize| !queued.contains(cell) && !self.folder.cell(self.id(*cell)).is_settled(true);
        let missing: HashSet<usize> = self.taken.iter().copied().filter(lost).collect();
        let mut sure: Vec<usize> = missing.intersection(&self.suspects).copied().collect();
        sure.sort_unstable();
        if !sure.is_empty() {
            self.refuse_cancelled(&missing)?;
            self.report_lost(&sure);
        }
        for &cell in &sure {
            self.taken.remove(&cell);
            let job = self.last.get(&cell).map(|&(submission, index)| (self.submissions[submission].number, index));
            let begun = job.and_then(|job| self.cursors.get(&job)).map(|cursor| &cursor.cells);
            // If the job had started only other cells, its end does not count as a failed attempt at this cell.
            let was_started = begun.is_none_or(|cells| cells.is_empty() || cells.contains(&cell));
            self.pending_events.push(match was_started {
                true => BackendEvent::Event(cell, CellEvent::Killed { reason: self.describe_end(cell) }),
                false => BackendEvent::Returned(cell),
            });
        }
        self.suspects = &missing - &sure.into_iter().collect();
        Ok(())
    }

    /// Returns [`SlurmError::Cancelled`] if all jobs of the missing cells were cancelled, because then a user wants to
    /// stop the run.
    fn refuse_cancelled(&self, missing: &HashSet<usize>) -> Result<()> {
        let submission = |cell| self.last.get(cell).map(|&(submission, _)| &self.submissions[submission]);
        let cancelled = |cell| {
            let watched = submission(cell).is_some_and(|submission| self.watched.contains(&submission.number));
            watched && self.end_of(*cell).1 == "CANCELLED"
        };
        if self.live().next().is_some() || !missing.iter().all(cancelled) {
            return Ok(());
        }
        let numbers = missing.iter().filter_map(submission).filter_map(|submission| submission.names.job.clone());
        let mut arrays = distinct(numbers);
        arrays.sort_unstable();
        Err(SlurmError::Cancelled { arrays, missing: missing.len() }.into())
    }

    /// Tells the user which cells left the queue without a result, with the states of their jobs.
    fn report_lost(&mut self, cells: &[usize]) {
        let mut how =
            distinct(cells.iter().map(|&cell| self.end_of(cell)).map(|(job, state)| format!("{job} {state}")));
        if how.len() > 5 {
            how.truncate(4);
            how.push("and others".into());
        }
        let cells = count(cells.len(), "cell");
        self.pending_events
            .push(BackendEvent::Note(format!("{cells} left Slurm's queue without a result ({})", how.join(", "))));
    }

    /// Returns the name of a cell's last job, e.g. "17_3", and its state in Slurm's last answer.
    fn end_of(&self, cell: usize) -> (String, &str) {
        let Some(&(submission, index)) = self.last.get(&cell) else { return ("a job".into(), "gone") };
        let submission = &self.submissions[submission];
        let job = self.queue.iter().find(|job| job.index == index && submission.has(job));
        let array = submission.names.job.as_ref().unwrap_or(&submission.names.name);
        (format!("{array}_{index}"), job.map_or("gone", |job| &job.state))
    }

    /// Describes how a cell's last job ended, with the last line of its log.
    fn describe_end(&self, cell: usize) -> String {
        let (job, state) = self.end_of(cell);
        let log = self.last.get(&cell).map(|&(submission, index)| self.submissions[submission].log(index));
        let log = log.unwrap_or_default();
        let shown = log.display();
        match last_log_line(&log, 0) {
            Some(words) => format!("Slurm job {job} ({state}) said `{words}`, see {shown}"),
            None => format!("Slurm job {job} ({state}) wrote nothing to {shown}: can the nodes access its folder?"),
        }
    }

    /// Submits as many cells of `groups` as Slurm allows in one array, and returns their indices.
    fn submit(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<usize>> {
        let max_jobs = match self.slurm.max_jobs(self.stop) {
            Ok(number) => number,
            Err(error) => return self.postpone_submission(error.into()),
        };
        // Divides the cells into jobs, and writes the files of the submission.
        let jobs = batches(&self.loads(groups)?, self.size(), max_jobs);
        let cells = jobs.concat();
        let ids = jobs.iter().map(|job| job.iter().map(|&cell| self.id(cell).to_owned()).collect()).collect();
        let text = |path: &Path| Ok(script(&self.options.task, self.folder.path(), path)?);
        let mut submission = submission::create(self.folder, self.plan, ids, &text)?;
        // Sends the job array to Slurm.
        let array = match self.slurm.submit(&submission, self.options) {
            Ok(array) => array,
            Err(error @ (SlurmError::Refused { .. } | SlurmError::NotInstalled { .. } | SlurmError::Option(_))) => {
                submission.forget()?; // Slurm accepted nothing
                return self.postpone_submission(error.into());
            }
            Err(error) => return Err(error.into()),
        };
        submission.accepted(&array)?;
        // Informs the user, and follows the jobs from now on.
        let most = jobs.iter().map(Vec::len).max().unwrap_or_default();
        self.pending_events.push(BackendEvent::Note(format!(
            "submitted {} as Slurm job {array}: {} of at most {}",
            count(cells.len(), "cell"),
            count(jobs.len(), "job"),
            count(most, "cell")
        )));
        self.queue.extend((0..jobs.len()).map(|index| QueuedJob::pending(&array, index, &submission.names.name)));
        self.watched.insert(submission.number);
        self.submissions.push(submission);
        self.remember(self.submissions.len() - 1);
        Ok(cells)
    }

    /// Handles a refused submission. If other jobs are in the queue, a limit on their number may be the cause, so the
    /// cells wait for a later submission. Otherwise the error ends the run.
    fn postpone_submission(&mut self, error: RunError) -> Result<Vec<usize>> {
        if self.live().next().is_none() {
            return Err(error);
        }
        self.report_and_continue(&error);
        Ok(Vec::new())
    }

    /// Returns the maximum size of a job. Without `cells_per_job`, a job should take [`JOB_SECONDS`], or half of its
    /// time limit if that is less. The size sums the durations of cells, so it is multiplied by the number of groups
    /// that run in parallel.
    fn size(&self) -> JobSize {
        let limit = self.options.time.as_ref().map_or(f64::INFINITY, |limit| limit.seconds() as f64 / 2.0);
        match self.options.cells_per_job {
            Some(number) => JobSize::Cells(number),
            None => JobSize::Seconds(JOB_SECONDS.min(limit) * self.options.task.jobs as f64),
        }
    }

    /// Estimates the duration of each cell, from finished cells with the same environment and method or from a
    /// measurement.
    fn loads(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<Vec<CellLoad>>> {
        let unknown = groups.iter().flatten().any(|offer| offer.seconds.is_none());
        if self.options.cells_per_job.is_none() && unknown && self.known_costs.is_none() {
            self.known_costs = Some((self.costs)().map_err(SlurmError::Cost)?);
        }
        let known = self.known_costs.as_deref().unwrap_or_default();
        let load = |&PendingCell { cell, seconds, .. }: &PendingCell| CellLoad {
            cell,
            seconds: seconds.or(known.get(cell).copied()).unwrap_or_default(),
        };
        Ok(groups.iter().map(|group| group.iter().map(load).collect()).collect())
    }

    /// Returns the jobs that are running or waiting.
    fn live(&self) -> impl Iterator<Item = &QueuedJob> {
        self.queue.iter().filter(|job| job.is_live())
    }

    /// Returns the indices of all cells whose jobs are in the queue.
    fn queued(&self) -> HashSet<usize> {
        let cells =
            |job: &QueuedJob| self.submissions.iter().find(|submission| submission.has(job))?.jobs.get(job.index);
        self.live().filter_map(cells).flatten().filter_map(|id| self.places.get(&**id).copied()).collect()
    }

    fn id(&self, cell: usize) -> &'a str {
        &self.plan.cells[cell].id
    }
}

impl Backend for Jobs<'_> {
    /// Returns one group for each kind of cells. Each job divides its own cells into smaller groups.
    fn grouping(&self) -> Grouping {
        Grouping::BY_KIND
    }

    fn records_crashes_as_failures(&self) -> bool {
        false
    }

    /// Returns false: the scheduler finds results in the folder.
    fn reports_ends(&self) -> bool {
        false
    }

    fn poll(&mut self, now: Instant) -> Result<Vec<BackendEvent>> {
        self.deciding = None;
        if self.ask_at.is_none_or(|time| now >= time) {
            self.ask_at = Some(now + self.options.queue_interval);
            // Only the process that holds this lock decides what to submit.
            let directory = submission::directory(self.folder);
            create_folder(&directory)?;
            self.deciding = Lock::try_take(&directory)?;
            match self.ask() {
                Ok(()) => {
                    self.report_queued_arrays()?;
                    self.return_lost_cells()?;
                }
                Err(error) if self.answers > 0 => {
                    self.deciding = None;
                    self.report_and_continue(&error);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(std::mem::take(&mut self.pending_events))
    }

    fn free_slots(&self) -> usize {
        if self.deciding.is_some() { usize::MAX } else { 0 }
    }

    fn begin(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<usize>> {
        let queued = self.queued();
        let (mut taken, mut missing) = (Vec::new(), Vec::new());
        for group in groups {
            let mut left = Vec::new();
            for offer in group {
                let place = self.folder.cell(self.id(offer.cell));
                match offer.retry {
                    // The job that recorded this failure no longer works on the cell, although it may still run other
                    // cells.
                    Some(failure) if place.failure_id() == Some(failure) => {
                        if place.clear_failure_if(failure)? {
                            left.push(*offer);
                        }
                    }
                    _ if queued.contains(&offer.cell) => taken.push(offer.cell),
                    // An earlier process submitted this cell. It is submitted again only if its job is missing in two
                    // answers of Slurm.
                    _ if self.answers == 1 && self.last.contains_key(&offer.cell) => {}
                    _ => left.push(*offer),
                }
            }
            if !left.is_empty() {
                missing.push(left);
            }
        }
        if !missing.is_empty() {
            taken.extend(self.submit(&missing)?);
        }
        self.taken.extend(&taken);
        Ok(taken)
    }

    fn max_seconds(&self, cell: usize) -> Option<f64> {
        self.known_costs.as_ref()?.get(cell).copied()
    }

    fn load(&self) -> (String, usize) {
        let (running, waiting): (Vec<&QueuedJob>, Vec<&QueuedJob>) = self.live().partition(|job| !job.node.is_empty());
        let nodes: HashSet<&str> = running.iter().map(|job| job.node.as_str()).collect();
        let mut reasons = waiting.iter().map(|job| job.reason.as_str());
        let reason = reasons.find(|reason| !["", "None", "(null)"].contains(reason));
        let reason = reason.map_or_else(String::new, |reason| format!(" ({reason})"));
        let on_nodes = format!("{} on {}", count(running.len(), "job"), count(nodes.len(), "node"));
        let words = match (running.len(), waiting.len()) {
            (0, 0) => "nothing in the queue".into(),
            (0, waiting) => format!("{} waiting{reason}", count(waiting, "job")),
            (_, 0) => on_nodes,
            (_, waiting) => format!("{on_nodes}, {waiting} waiting{reason}"),
        };
        (words, running.len().max(1) * self.options.task.jobs)
    }

    fn stop(&mut self) -> Vec<String> {
        distinct(self.live().map(|job| job.array.clone()))
    }
}
