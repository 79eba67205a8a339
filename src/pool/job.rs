//! The shards of a batch, and the state of the request that the workers run on them.

use super::{
    Error, capacity::Permit, pipelined_step::PipelinedStep, rollout::task::RolloutTask, shard::Shard, sync::lock,
};
use crate::meters::Tally;
use std::{
    ops::Range,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
};
use tokio::sync::Notify;

/// The maximum cost of a batch's step that runs on the session's thread, µs. Passing such a cheap step to a worker
/// would take longer than running it.
pub(super) const INLINE_MAX_US: f64 = 20.0;
/// The limit that replaces [`INLINE_MAX_US`], in µs, if the server's previous step was of the same session. Other
/// sessions are then probably idle. Up to this cost, passing the batch to workers takes longer than running it in
/// parallel saves.
pub(super) const INLINE_MAX_US_UNCONTENDED: f64 = 80.0;
/// The maximum cost of a batch's step, µs, at which resets of the batch also run on the session's thread. A reset costs
/// as much as a few steps.
pub(super) const INLINE_RESET_MAX_US: f64 = 4.0;
/// The maximum cost of a job's step, µs, at which the session polls for the end of the step before it sleeps. For more
/// expensive steps it sleeps at once.
const POLL_MAX_US: f64 = 50.0;
/// The number of polls before the session sleeps. Together the polls take about twice [`POLL_MAX_US`].
const POLLS_BEFORE_WAIT: usize = 50;

/// The work that follows after a job's step.
pub(super) enum Continuation {
    Nothing,
    /// Runs another step of the rollout.
    Step,
    /// Runs the pipelined step, which belongs to the next request.
    Request,
}

/// The work of a batch, as the workers see it: its shards, and the state of the running request. At most one request
/// runs, and at most one pipelined step waits behind it.
pub(super) struct Job {
    pub(super) shards: Vec<Mutex<Shard>>,
    /// For each worker, the range of shards that it runs first, and the index of the next shard in that range. A worker
    /// that runs the same environments at each step finds them in its core's cache. When the worker has finished its
    /// range, it runs shards of other ranges.
    ranges: Vec<(Range<usize>, AtomicUsize)>,
    /// The number of parts of the running step that have not finished. A part is a shard or the start of a rollout.
    remaining: AtomicUsize,
    /// The running rollout, if there is one.
    rollout: Mutex<Option<Box<RolloutTask>>>,
    /// The pipelined step that may follow the running step. Not used during a rollout.
    pub(super) pipelined: Mutex<PipelinedStep>,
    /// Whether the job's next part is the start of a rollout instead of a shard.
    begins_rollout: AtomicBool,
    /// The number of requests that the workers have finished so far.
    pub(super) ended: AtomicU64,
    /// Notified whenever a request has ended.
    pub(super) done: Notify,
    /// Whether the session has ended. If so, shards that have not run yet are skipped.
    pub(super) abandoned: AtomicBool,
    /// Whether the rollout must end after its current step, because its future was dropped.
    pub(super) is_halted: AtomicBool,
    failed: AtomicBool,
    /// The estimated cost of a step of all environments, µs.
    pub(super) cost: f64,
    /// The number of times that the session polls for the end of a request before it sleeps.
    pub(super) polls: usize,
    pub(super) permit: Arc<Permit>,
    pub(super) tally: Arc<Tally>,
}

impl Job {
    /// Makes the job of a batch, for `workers` workers. `cost` is the estimated cost of a step of all environments, µs.
    pub(super) fn new(
        shards: Vec<Mutex<Shard>>,
        workers: usize,
        (permit, tally): (Arc<Permit>, Arc<Tally>),
        cost: f64,
        pipelined: PipelinedStep,
    ) -> Self {
        let bound = |worker: usize| worker * shards.len() / workers;
        let range = |worker: usize| (bound(worker)..bound(worker + 1), AtomicUsize::new(0));
        Self {
            ranges: (0..workers).map(range).collect(),
            shards,
            remaining: AtomicUsize::new(0),
            rollout: Mutex::new(None),
            pipelined: Mutex::new(pipelined),
            begins_rollout: AtomicBool::new(false),
            ended: AtomicU64::new(0),
            done: Notify::new(),
            abandoned: AtomicBool::new(false),
            is_halted: AtomicBool::new(false),
            failed: AtomicBool::new(false),
            cost,
            polls: if cost <= POLL_MAX_US { POLLS_BEFORE_WAIT } else { 0 },
            permit,
            tally,
        }
    }

    /// Whether the batch is always stepped by workers, and never on the session's thread.
    pub(super) fn needs_workers(&self) -> bool {
        self.cost > INLINE_MAX_US_UNCONTENDED
    }

    /// Whether a worker has panicked in this job.
    pub(super) fn failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    pub(super) fn result(&self) -> Result<(), Error> {
        if self.failed() { Err(Error::Defect) } else { Ok(()) }
    }

    /// Makes all shards available to the workers.
    pub(super) fn prepare(&self) {
        for (range, next) in &self.ranges {
            next.store(range.start, Ordering::Relaxed);
        }
        self.remaining.store(self.shards.len(), Ordering::Relaxed);
    }

    /// Claims a shard that no worker has taken, preferably from the worker's own range. Such a shard always exists,
    /// because the caller has taken a part from the queue.
    fn claim(&self, worker: usize) -> usize {
        loop {
            for i in 0..self.ranges.len() {
                let (range, next) = &self.ranges[(worker + i) % self.ranges.len()];
                let shard = next.fetch_add(1, Ordering::Relaxed);
                if shard < range.end {
                    return shard;
                }
            }
        }
    }

    /// Makes the start of a rollout available to the workers, as the job's only part.
    pub(super) fn prepare_rollout(&self, rollout: Box<RolloutTask>) {
        *lock(&self.rollout) = Some(rollout);
        self.is_halted.store(false, Ordering::Relaxed);
        self.begins_rollout.store(true, Ordering::Relaxed);
        self.remaining.store(1, Ordering::Relaxed);
    }

    /// Takes the rollout out of the job, after its end or if it will never run.
    pub(super) fn take_rollout(&self) -> Option<Box<RolloutTask>> {
        lock(&self.rollout).take()
    }

    /// Runs a part of the job, after the caller has taken it from the queue. Returns whether it was the last part.
    pub(super) fn run_part(&self, worker: usize) -> bool {
        // The start of a rollout is the job's only part.
        if self.begins_rollout.swap(false, Ordering::Relaxed) {
            self.remaining.store(0, Ordering::Release);
            return true;
        }
        self.run(self.claim(worker))
    }

    /// Notifies the session that a request has ended.
    pub(super) fn notify_done(&self) {
        self.ended.fetch_add(1, Ordering::Release);
        self.done.notify_one();
    }

    /// Decides after a step whether another step follows. If the pool is `closing`, no step follows.
    pub(super) fn after_step(&self, closing: bool) -> Continuation {
        if self.failed() || self.abandoned.load(Ordering::Relaxed) {
            lock(&self.pipelined).stop();
            return Continuation::Nothing;
        }
        let mut rollout = lock(&self.rollout);
        let Some(rollout) = rollout.as_mut() else {
            drop(rollout);
            let mut pipelined = lock(&self.pipelined);
            if closing {
                pipelined.stop();
            }
            return self.catch_panic(Continuation::Request, || pipelined.after_step(&self.shards));
        };
        let is_halted = closing || self.is_halted.load(Ordering::Relaxed);
        self.catch_panic(Continuation::Step, || rollout.after_step(&self.shards, is_halted))
    }

    /// Returns `next` if the closure `is_wanted` returns true, otherwise `Nothing`. If `is_wanted` panics, marks the
    /// job as failed.
    fn catch_panic(&self, next: Continuation, is_wanted: impl FnOnce() -> bool) -> Continuation {
        match catch_unwind(AssertUnwindSafe(is_wanted)) {
            Ok(true) => next,
            Ok(false) => Continuation::Nothing,
            Err(_) => {
                tracing::error!("a worker panicked between two steps; the batch is lost");
                self.failed.store(true, Ordering::Relaxed);
                Continuation::Nothing
            }
        }
    }

    /// Runs a shard's command. Returns whether it was the last shard to finish.
    pub(super) fn run(&self, index: usize) -> bool {
        if !self.abandoned.load(Ordering::Relaxed) {
            let run = AssertUnwindSafe(|| lock(&self.shards[index]).run());
            match catch_unwind(run) {
                Ok((steps, episodes)) => self.tally.add(steps, episodes),
                Err(_) => {
                    tracing::error!(shard = index, "a worker panicked; the batch is lost");
                    self.failed.store(true, Ordering::Relaxed);
                }
            }
        }
        // Acquire and release: the worker that finishes last sees the outputs of all shards.
        self.remaining.fetch_sub(1, Ordering::AcqRel) == 1
    }
}
