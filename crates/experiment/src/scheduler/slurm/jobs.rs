//! Submits cells as job arrays, and follows their jobs.

use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::time::Instant;

use perturb_files::interrupt::StopFlag;
use perturb_files::{AnyError, Lock, create_folder, io, open_plain};

use perturb_text::shortened;

use super::super::event::{last_words, read_lines};
use super::super::{Backend, BackendEvent, CellEvent, PendingCell, Result, RunError, count};
use super::batch::{CellLoad, JOB_SECONDS, JobSize, batches};
use super::commands::{QueueAnswer, Slurm};
use super::error::SlurmError;
use super::job::QueuedJob;
use super::options::SlurmOptions;
use super::script::script;
use super::submission::{self, Submission};
use crate::folder::Folder;
use crate::plan::{Grouping, Plan, distinct};

/// Maximum number of different lines of squeue without a job that are reported.
const MAX_FOREIGN_LINES: usize = 10;

/// The jobs of a folder in Slurm's queue. Jobs that are in the queue when this process ends stay there.
pub struct Jobs<'a> {
    plan: &'a Plan,
    folder: &'a Folder,
    slurm: &'a Slurm,
    options: &'a SlurmOptions,
    costs: &'a dyn Fn() -> Result<Vec<f64>, AnyError>,
    known_costs: Option<Vec<f64>>,
    stop: &'a StopFlag,
    /// Indices in the plan, by the cells' ids.
    places: HashMap<&'a str, usize>,
    submissions: Vec<Submission>,
    /// The last job of each cell: the index of its submission, and its index in the array.
    last: HashMap<usize, (usize, usize)>,
    /// Slurm's last answer, and the number of answers so far.
    queue: Vec<QueuedJob>,
    answers: u32,
    /// Positions in the jobs' event files, by submission and index.
    told: HashMap<(u32, usize), LogCursor>,
    /// Submissions that this process has seen in the queue.
    watched: HashSet<u32>,
    /// Cells that the scheduler handed to this backend and that were not given back.
    taken: HashSet<usize>,
    /// Cells in `taken` that were missing in Slurm's last answer.
    suspects: HashSet<usize>,
    /// Lock on the decision what to submit. It is held from the request for the queue to the submission.
    deciding: Option<Lock>,
    ask_at: Option<Instant>,
    /// Lines of squeue without a job that were reported already.
    foreign: HashSet<String>,
    /// The reason why Slurm does not answer or does not accept jobs.
    trouble: Option<String>,
    /// Events for the next call of `poll`.
    news: Vec<BackendEvent>,
}

/// Read position in the event file of a job, and the cells that the job has started according to these events.
#[derive(Default)]
struct LogCursor {
    offset: u64,
    cells: HashSet<usize>,
}

impl<'a> Jobs<'a> {
    /// Returns the jobs of `folder`. `costs` estimates the duration of each cell by index, s; it is called at most
    /// once, before the first submission.
    pub fn new(
        plan: &'a Plan,
        folder: &'a Folder,
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
            told: HashMap::new(),
            watched: HashSet::new(),
            taken: HashSet::new(),
            suspects: HashSet::new(),
            deciding: None,
            ask_at: None,
            foreign: HashSet::new(),
            trouble: None,
            news: Vec::new(),
        }
    }

    /// Asks Slurm for the jobs of all submissions with unfinished cells of the plan.
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
                self.news.push(BackendEvent::Note(format!("squeue printed a line that is no job, ignored: {line}")));
            }
        }
        // If the folder was deleted and made again, its names also belong to older arrays.
        self.queue.retain(|job| submissions.iter().any(|submission| submission.has(job)));
        self.submissions = submissions;
        self.last.clear();
        (0..self.submissions.len()).for_each(|submission| self.remember(submission));
        self.answers += 1;
        self.trouble = None;
        Ok(())
    }

    /// Records the last job of each cell in a submission.
    fn remember(&mut self, submission: usize) {
        for (index, cells) in self.submissions[submission].jobs.iter().enumerate() {
            let cells = cells.iter().filter_map(|id| self.places.get(&**id));
            self.last.extend(cells.map(|&cell| (cell, (submission, index))));
        }
    }

    /// Continues without an answer of Slurm, and reports the error once.
    fn put_up_with(&mut self, error: &RunError) {
        let words = error.to_string();
        if self.trouble.as_ref() != Some(&words) {
            self.news.push(BackendEvent::Note(format!("{words}; results are still read, and Slurm is asked again")));
            self.trouble = Some(words);
        }
    }

    /// Records which arrays are in the queue, and the numbers of arrays whose submission was interrupted.
    fn adopt(&mut self) -> Result<()> {
        for submission in &mut self.submissions {
            let jobs: Vec<_> = self.queue.iter().filter(|job| job.is_live() && submission.has(job)).collect();
            let Some(first) = jobs.first() else { continue };
            if submission.names.job.is_none() {
                submission.accepted(&first.array)?;
            }
            if self.watched.insert(submission.number) {
                let jobs = count(jobs.len(), "job");
                self.news.push(BackendEvent::Note(format!("Slurm job {} is in the queue, with {jobs}", first.array)));
            }
        }
        Ok(())
    }

    /// Reads the new events of job `index`.
    fn read(&mut self, submission: usize, index: usize) -> Result<()> {
        let submission = &self.submissions[submission];
        let path = submission.events(index);
        if !path.exists() {
            return Ok(()); // it has not begun
        }
        // The file is opened each time, because a network file system then looks for new content.
        let (file, _) = open_plain(&path).map_err(io("open", &path))?;
        let told = self.told.entry((submission.number, index)).or_default();
        for line in read_lines(&file, &mut told.offset).map_err(io("read", &path))? {
            let Some(&cell) = self.places.get(&*line.cell) else { continue };
            if line.event.is_a_turn() {
                told.cells.insert(cell);
            }
            // A job repeats attempts itself, so an attempt's end is not reported while the job runs.
            if !line.event.is_last() {
                self.news.push(BackendEvent::Event(cell, line.event));
            }
        }
        Ok(())
    }

    /// Reads the events of running jobs, and gives back the cells whose jobs have left the queue. A job must be missing in
    /// two answers in succession, because a result may become visible here a little after the end of its job.
    fn give_back(&mut self) -> Result<()> {
        let jobs: HashSet<(usize, usize)> = self.taken.iter().filter_map(|cell| self.last.get(cell).copied()).collect();
        for (submission, index) in jobs {
            if let Err(error) = self.read(submission, index) {
                self.put_up_with(&error);
            }
        }
        let queued = self.queued();
        let lost = |cell: &usize| !queued.contains(cell) && !self.folder.cell(self.id(*cell)).is_settled(true);
        let missing: HashSet<usize> = self.taken.iter().copied().filter(lost).collect();
        let mut sure: Vec<usize> = missing.intersection(&self.suspects).copied().collect();
        sure.sort_unstable();
        if !sure.is_empty() {
            self.refuse_cancelled(&missing)?;
            self.say_lost(&sure);
        }
        for &cell in &sure {
            self.taken.remove(&cell);
            let job = self.last.get(&cell).map(|&(submission, index)| (self.submissions[submission].number, index));
            let told = job.and_then(|job| self.told.get(&job)).map(|told| &told.cells);
            // The end of a job does not count against a cell that the job had not started.
            let had_its_turn = told.is_none_or(|cells| cells.is_empty() || cells.contains(&cell));
            self.news.push(match had_its_turn {
                true => BackendEvent::Event(cell, CellEvent::Killed { reason: self.how_it_ended(cell) }),
                false => BackendEvent::Returned(cell),
            });
        }
        self.suspects = &missing - &sure.into_iter().collect();
        Ok(())
    }

    /// Ends the run if all jobs of the missing cells were cancelled, because that was intended.
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

    fn say_lost(&mut self, cells: &[usize]) {
        let mut how =
            distinct(cells.iter().map(|&cell| self.end_of(cell)).map(|(job, state)| format!("{job} {state}")));
        if how.len() > 5 {
            how.truncate(4);
            how.push("and others".into());
        }
        let cells = count(cells.len(), "cell");
        self.news.push(BackendEvent::Note(format!("{cells} left Slurm's queue without a result ({})", how.join(", "))));
    }

    /// Returns the name of the last job of a cell, and its final state.
    fn end_of(&self, cell: usize) -> (String, &str) {
        let Some(&(submission, index)) = self.last.get(&cell) else { return ("a job".into(), "gone") };
        let submission = &self.submissions[submission];
        let job = self.queue.iter().find(|job| job.index == index && submission.has(job));
        let array = submission.names.job.as_ref().unwrap_or(&submission.names.name);
        (format!("{array}_{index}"), job.map_or("gone", |job| &job.state))
    }

    /// Describes the end of a cell's last job, with the job's last output.
    fn how_it_ended(&self, cell: usize) -> String {
        let (job, state) = self.end_of(cell);
        let log = self.last.get(&cell).map(|&(submission, index)| self.submissions[submission].log(index));
        let log = log.unwrap_or_default();
        let shown = log.display();
        match last_words(&log, 0) {
            Some(words) => format!("Slurm job {job} ({state}) said `{words}`, see {shown}"),
            None => format!("Slurm job {job} ({state}) wrote nothing to {shown}: do the nodes see this folder?"),
        }
    }

    /// Submits the cells of `groups` that Slurm accepts, and returns them.
    fn submit(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<usize>> {
        let max_jobs = match self.slurm.max_jobs(self.stop) {
            Ok(number) => number,
            Err(error) => return self.put_off(error.into()),
        };
        let jobs = batches(&self.loads(groups)?, self.size(), max_jobs);
        let cells = jobs.concat();
        let ids = jobs.iter().map(|job| job.iter().map(|&cell| self.id(cell).to_owned()).collect()).collect();
        let text = |path: &Path| Ok(script(&self.options.task, self.folder.path(), path)?);
        let mut submission = submission::create(self.folder, self.plan, ids, &text)?;
        let array = match self.slurm.submit(&submission, self.options) {
            Ok(array) => array,
            Err(error @ (SlurmError::Refused { .. } | SlurmError::NotInstalled { .. } | SlurmError::Option(_))) => {
                submission.forget()?; // nothing was accepted
                return self.put_off(error.into());
            }
            Err(error) => return Err(error.into()),
        };
        submission.accepted(&array)?;
        let most = jobs.iter().map(Vec::len).max().unwrap_or_default();
        self.news.push(BackendEvent::Note(format!(
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

    /// Handles a refused submission. While jobs are in the queue, the cause may be a limit on their number, so the cells
    /// wait for a later attempt. Otherwise the error ends the run.
    fn put_off(&mut self, error: RunError) -> Result<Vec<usize>> {
        if self.live().next().is_none() {
            return Err(error);
        }
        self.put_up_with(&error);
        Ok(Vec::new())
    }

    fn size(&self) -> JobSize {
        let limit = self.options.time.as_ref().map_or(f64::INFINITY, |limit| limit.seconds() as f64 / 2.0);
        match self.options.cells_per_job {
            Some(number) => JobSize::Cells(number),
            None => JobSize::Seconds(JOB_SECONDS.min(limit) * self.options.task.jobs as f64),
        }
    }

    /// Estimates the duration of each cell from finished cells of its kind or from a measurement.
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

    fn live(&self) -> impl Iterator<Item = &QueuedJob> {
        self.queue.iter().filter(|job| job.is_live())
    }

    /// Returns the cells of the jobs in the queue.
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
    /// Returns one group for each kind of cells. A job divides its cells into groups itself.
    fn grouping(&self) -> Grouping {
        Grouping::BY_KIND
    }

    fn records_crashes_as_failures(&self) -> bool {
        false
    }

    /// Returns false, because a run finds the results in the folder.
    fn tells_ends(&self) -> bool {
        false
    }

    fn poll(&mut self, now: Instant) -> Result<Vec<BackendEvent>> {
        self.deciding = None;
        if self.ask_at.is_none_or(|time| now >= time) {
            self.ask_at = Some(now + self.options.queue_interval);
            // Only one process at a time decides what to submit.
            let directory = submission::directory(self.folder);
            create_folder(&directory)?;
            self.deciding = Lock::try_take(&directory)?;
            match self.ask() {
                Ok(()) => {
                    self.adopt()?;
                    self.give_back()?;
                }
                Err(error) if self.answers > 0 => {
                    self.deciding = None;
                    self.put_up_with(&error);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(std::mem::take(&mut self.news))
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
                    // The job that recorded this failure has finished with the cell, although it may still run others.
                    Some(failure) if place.failure_id() == Some(failure) => {
                        if place.clear_failure_if(failure)? {
                            left.push(*offer);
                        }
                    }
                    _ if queued.contains(&offer.cell) => taken.push(offer.cell),
                    // An earlier process submitted this cell, so it must be missing in two answers.
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
