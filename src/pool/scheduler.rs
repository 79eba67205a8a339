//! The pool's worker threads, and the queue from which they take work.

use super::{
    Error,
    capacity::Capacity,
    job::{Continuation, INLINE_MAX_US, INLINE_MAX_US_UNCONTENDED, INLINE_RESET_MAX_US, Job},
    reaper::Reaper,
    rollout::task::RolloutTask,
    sync::lock,
};
use crate::{
    meters::{Histogram, Meter},
    priority::lower,
};
use perturb_system::explain_no_thread;
use std::{
    collections::{BTreeMap, VecDeque},
    io,
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering},
    },
    thread::{self, JoinHandle},
};
use tokio::time::Instant;

/// The number of times that an idle worker yields its core before it sleeps. Yielding avoids the cost of waking a
/// sleeping worker, which takes longer than a step of many small environments.
const YIELDS_BEFORE_SLEEP: usize = 100;

/// The niceness of the workers, which gives them a lower priority than the transport threads. The transport threads
/// work only in short bursts, so they should not wait for a worker.
const WORKER_NICENESS: i32 = 1;

/// The worker threads that run batches, and the limit on the number of environments.
pub struct Pool {
    shared: Arc<StepScheduler>,
    threads: Vec<JoinHandle<()>>,
}

impl Pool {
    /// Starts `workers` threads, at least 1, for at most `max_environments` environments at a time.
    ///
    /// # Errors
    /// If the operating system cannot start a thread.
    pub fn new(workers: usize, max_environments: usize) -> io::Result<Self> {
        let (reaper, freeing) = Reaper::start()?;
        let shared = Arc::new(StepScheduler {
            reaper,
            capacity: Arc::new(Capacity::new(max_environments)),
            queue: Mutex::new(JobQueue { jobs: VecDeque::with_capacity(1024), sleeping: 0, closed: false }),
            waiting: AtomicUsize::new(0),
            ready: Condvar::new(),
            closing: AtomicBool::new(false),
            last_stepped: AtomicPtr::default(),
            meters: Mutex::default(),
            waits: Histogram::default(),
        });
        let mut pool = Self { shared, threads: Vec::new() };
        for i in 0..workers.max(1) {
            let shared = Arc::clone(&pool.shared);
            let thread = thread::Builder::new()
                .name(format!("physics-{i}"))
                .spawn(move || shared.work(i))
                .map_err(|error| explain_no_thread(&error))?;
            pool.threads.push(thread);
        }
        pool.threads.push(freeing);
        Ok(pool)
    }

    /// The number of worker threads.
    pub fn workers(&self) -> usize {
        self.threads.len() - 1
    }

    /// The number of environments in use.
    pub fn environments(&self) -> usize {
        self.shared.capacity.used()
    }

    /// The maximum number of environments.
    pub fn limit(&self) -> usize {
        self.shared.capacity.limit()
    }

    /// Waits until the number of environments in use has changed since the last call. Only one task may wait.
    pub async fn changed(&self) {
        self.shared.capacity.changed().await;
    }

    /// Returns the counters of steps and episodes for the environment with this name.
    pub fn meter(&self, environment: &'static str) -> Arc<Meter> {
        Arc::clone(lock(&self.shared.meters).entry(environment).or_default())
    }

    /// Returns the counters of all environments for which [`Pool::meter`] was called, by name.
    pub fn meters(&self) -> BTreeMap<&'static str, Arc<Meter>> {
        lock(&self.shared.meters).clone()
    }

    /// Returns the histogram of the times that batches waited in the queue until a worker took a shard.
    pub fn waits(&self) -> &Histogram {
        &self.shared.waits
    }

    /// Waits until the reaper's thread has freed all environments that were passed to it.
    pub async fn freed(&self) {
        self.shared.reaper.idle().await;
    }

    pub(super) fn queue(&self) -> Arc<StepScheduler> {
        Arc::clone(&self.shared)
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.closing.store(true, Ordering::Relaxed);
        lock(&self.shared.queue).closed = true;
        self.shared.reaper.close();
        self.shared.ready.notify_all();
        for thread in self.threads.drain(..) {
            // A worker never panics: shards run inside catch_unwind.
            let _ = thread.join();
        }
    }
}

/// The state that workers and batches share: the queue of jobs, counters, and limits.
pub(super) struct StepScheduler {
    pub(super) reaper: Reaper,
    pub(super) capacity: Arc<Capacity>,
    queue: Mutex<JobQueue>,
    /// The number of jobs in the queue. It can be read without locking the queue.
    waiting: AtomicUsize,
    ready: Condvar,
    /// Whether the pool is closing. If so, rollouts end after their current step, and pipelined steps are dropped.
    closing: AtomicBool,
    /// The job that was stepped last. The pointer is only compared, never dereferenced.
    last_stepped: AtomicPtr<Job>,
    meters: Mutex<BTreeMap<&'static str, Arc<Meter>>>,
    waits: Histogram,
}

struct JobQueue {
    /// A FIFO of entries (job, number of parts, time of enqueueing). The number counts the job's parts that no worker
    /// has taken, and is at least 1. A part is a shard or the start of a rollout.
    jobs: VecDeque<(Arc<Job>, usize, Instant)>,
    /// The number of workers that sleep until `ready` is notified.
    sleeping: usize,
    closed: bool,
}

impl StepScheduler {
    /// Runs a step of all shards on the calling thread, if the job is cheap. Returns whether the step was run.
    pub(super) fn step_inline(&self, job: &Job) -> bool {
        let max_us = if self.mark_last_stepped(job) { INLINE_MAX_US_UNCONTENDED } else { INLINE_MAX_US };
        run_inline(job, max_us)
    }

    /// Runs the resets of all shards on the calling thread, if the job is cheap. Returns whether the resets were run.
    pub(super) fn reset_inline(&self, job: &Job) -> bool {
        run_inline(job, INLINE_RESET_MAX_US)
    }

    /// Queues a step of all shards for the workers. A pipelined step may follow it.
    pub(super) fn begin_step(&self, job: &Arc<Job>) {
        lock(&job.pipelined).begin();
        self.begin(job);
    }

    /// Runs a request on the workers: queues all shards and waits for the end of request number `number`.
    pub(super) async fn run(&self, job: &Arc<Job>, number: u64) -> Result<(), Error> {
        self.begin(job);
        self.wait(job, number).await
    }

    fn begin(&self, job: &Arc<Job>) {
        job.prepare();
        let shards = job.shards.len();
        self.push(job, shards, shards); // the queue's lock makes the job's counters visible to the workers
    }

    /// Runs a rollout on the workers, as request number `number`. Returns the rollout after its end.
    pub(super) async fn run_rollout(
        &self,
        job: &Arc<Job>,
        rollout: Box<RolloutTask>,
        number: u64,
    ) -> Result<Box<RolloutTask>, Error> {
        self.mark_last_stepped(job);
        job.prepare_rollout(rollout);
        self.push(job, 1, 1);
        self.wait(job, number).await?;
        job.take_rollout().ok_or(Error::Defect)
    }

    /// Records that a job is stepped. Returns whether the previously stepped job was the same job.
    fn mark_last_stepped(&self, job: &Job) -> bool {
        let job = std::ptr::from_ref(job).cast_mut();
        self.last_stepped.swap(job, Ordering::Relaxed) == job
    }

    /// Waits until the workers have finished the first `number` requests of a job.
    pub(super) async fn wait(&self, job: &Arc<Job>, number: u64) -> Result<(), Error> {
        let has_ended = || job.ended.load(Ordering::Acquire) >= number;
        // For a cheap job, the session polls before it sleeps, because waking it often takes longer than the step.
        for _ in 0..job.polls {
            if has_ended() {
                break;
            }
            tokio::task::yield_now().await;
        }
        // The notification may belong to the previous request, so the counter is checked again.
        while !has_ended() {
            job.done.notified().await;
        }
        job.result()
    }

    /// Puts a job with `parts` parts at the back of the queue, and wakes sleeping workers. `helpers` is the number of
    /// wanted workers. If at least two workers are wanted and at least two sleep, wakes all that sleep.
    fn push(&self, job: &Arc<Job>, parts: usize, helpers: usize) {
        let now = Instant::now();
        let mut queue = lock(&self.queue);
        queue.jobs.push_back((Arc::clone(job), parts, now));
        self.waiting.store(queue.jobs.len(), Ordering::Release);
        let sleeping = queue.sleeping;
        drop(queue);
        // If no worker sleeps, none is notified, because every notification costs a system call.
        match sleeping.min(helpers) {
            0 => {}
            1 => self.ready.notify_one(),
            _ => self.ready.notify_all(),
        }
    }

    /// Takes one part of the job at the front of the queue. If further parts of the job remain, moves the job to the
    /// back of the queue for other workers. Returns `None` after the queue was closed.
    fn pop(&self) -> Option<Arc<Job>> {
        for _ in 0..YIELDS_BEFORE_SLEEP {
            if self.waiting.load(Ordering::Acquire) > 0 {
                break;
            }
            thread::yield_now();
        }
        let mut queue = lock(&self.queue);
        loop {
            if let Some((job, parts, since)) = queue.jobs.pop_front() {
                let now = Instant::now();
                self.waits.observe(now - since);
                if parts > 1 {
                    queue.jobs.push_back((Arc::clone(&job), parts - 1, now));
                }
                self.waiting.store(queue.jobs.len(), Ordering::Release);
                return Some(job);
            }
            if queue.closed {
                return None;
            }
            queue.sleeping += 1;
            queue = self.ready.wait(queue).unwrap_or_else(PoisonError::into_inner);
            queue.sleeping -= 1;
        }
    }

    fn work(&self, worker: usize) {
        lower(WORKER_NICENESS);
        while let Some(job) = self.pop() {
            if job.run_part(worker) {
                self.after_step(&job);
            }
        }
    }

    /// Called after the last part of a job. Starts another step if a rollout or a pipelined step needs one. Notifies
    /// the session if a request has ended.
    fn after_step(&self, job: &Arc<Job>) {
        loop {
            let next = job.after_step(self.closing.load(Ordering::Relaxed));
            if matches!(next, Continuation::Nothing) {
                return job.notify_done();
            }
            job.prepare();
            let shards = job.shards.len();
            // Jobs that wait in the queue come first. If no job waits and this job has a single shard, this worker runs
            // the job again directly: the cache of this worker's core holds the environments. If the job were queued,
            // another worker might take the job.
            let runs_here = shards == 1 && self.waiting.load(Ordering::Acquire) == 0;
            if !runs_here {
                self.push(job, shards, shards - 1);
            }
            if matches!(next, Continuation::Request) {
                self.mark_last_stepped(job);
                job.notify_done();
            }
            if !runs_here {
                return;
            }
            job.run(0);
        }
    }
}

/// Runs all shards on the calling thread if a step of the job costs at most `max_us` µs. Returns whether the shards
/// were run.
fn run_inline(job: &Job, max_us: f64) -> bool {
    if job.cost > max_us {
        return false;
    }
    job.prepare();
    (0..job.shards.len()).for_each(|shard| _ = job.run(shard));
    true
}
