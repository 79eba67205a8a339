//! A batch's shards, and the request of it that is under way.

use super::{
    Error, capacity::Permit, pipelined_step::PipelinedStep, rollout::round::RolloutTask, shard::Shard, sync::lock,
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

/// Batches cheaper than this run on the session's thread, since a hand-over to a worker costs more.
pub(super) const INLINE_MAX_US: f64 = 20.0;
/// The same limit while no other session has stepped meanwhile. A hand-over costs more than a second worker saves, and no
/// other session waits.
pub(super) const INLINE_MAX_US_UNCONTENDED: f64 = 80.0;
/// The session polls for the end of a job that is at most this expensive before it sleeps.
const POLL_MAX_US: f64 = 50.0;
/// The number of polls, which take about twice that time.
const POLLS_BEFORE_WAIT: usize = 50;

/// What a job does at a step's end.
pub(super) enum Continuation {
    Nothing,
    /// Another step of the round.
    Step,
    /// The step that follows: another request.
    Request,
}

/// A batch's shards and the state of its current request. A batch has at most one request under way, and one that follows.
pub(super) struct Job {
    pub(super) shards: Vec<Mutex<Shard>>,
    /// For each worker the shards that it takes first, and the next of them. A worker that meets the same environments
    /// again finds them in its core's cache; one that is done helps the others.
    ranges: Vec<(Range<usize>, AtomicUsize)>,
    /// Parts that have not finished.
    left: AtomicUsize,
    /// What decides between two steps whether and how there is another, while a policy plays.
    round: Mutex<Option<Box<RolloutTask>>>,
    /// What is to be done after a step without a round.
    pub(super) follow: Mutex<PipelinedStep>,
    /// The part that is to run next is the beginning of the round, not a shard.
    begins: AtomicBool,
    /// Requests that have ended, of those that workers were asked for.
    pub(super) ended: AtomicU64,
    /// Told whenever one has.
    pub(super) done: Notify,
    /// The session is gone: what has not run need not.
    pub(super) abandoned: AtomicBool,
    /// Nobody waits for the round any more: it ends with its present step.
    pub(super) halted: AtomicBool,
    failed: AtomicBool,
    /// What a step of all environments takes, µs.
    pub(super) cost: f64,
    /// How often the session looks whether a request is done before it sleeps until then.
    pub(super) patience: usize,
    pub(super) permit: Arc<Permit>,
    pub(super) tally: Arc<Tally>,
}

impl Job {
    /// A job of these shards for so many workers. One that takes about `cost` µs and is short is worth waiting for awake.
    pub(super) fn new(
        shards: Vec<Mutex<Shard>>,
        workers: usize,
        (permit, tally): (Arc<Permit>, Arc<Tally>),
        cost: f64,
        follow: PipelinedStep,
    ) -> Self {
        let bound = |worker: usize| worker * shards.len() / workers;
        let range = |worker: usize| (bound(worker)..bound(worker + 1), AtomicUsize::new(0));
        Self {
            ranges: (0..workers).map(range).collect(),
            shards,
            left: AtomicUsize::new(0),
            round: Mutex::new(None),
            follow: Mutex::new(follow),
            begins: AtomicBool::new(false),
            ended: AtomicU64::new(0),
            done: Notify::new(),
            abandoned: AtomicBool::new(false),
            halted: AtomicBool::new(false),
            failed: AtomicBool::new(false),
            cost,
            patience: if cost <= POLL_MAX_US { POLLS_BEFORE_WAIT } else { 0 },
            permit,
            tally,
        }
    }

    /// Whether workers step it, whoever else steps.
    pub(super) fn is_for_workers(&self) -> bool {
        self.cost > INLINE_MAX_US_UNCONTENDED
    }

    /// Whether a worker panicked on it, now or earlier.
    pub(super) fn failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    pub(super) fn result(&self) -> Result<(), Error> {
        if self.failed() { Err(Error::Defect) } else { Ok(()) }
    }

    /// Makes every shard ready to be taken.
    pub(super) fn prepare(&self) {
        for (range, next) in &self.ranges {
            next.store(range.start, Ordering::Relaxed);
        }
        self.left.store(self.shards.len(), Ordering::Relaxed);
    }

    /// A shard that nobody has taken: the worker's own first. The caller has it from the queue, so there is one.
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

    /// Makes the beginning of a round ready to be taken.
    pub(super) fn prepare_round(&self, round: Box<RolloutTask>) {
        *lock(&self.round) = Some(round);
        self.halted.store(false, Ordering::Relaxed);
        self.begins.store(true, Ordering::Relaxed);
        self.left.store(1, Ordering::Relaxed);
    }

    /// The round, when it has ended or will never be run.
    pub(super) fn take_round(&self) -> Option<Box<RolloutTask>> {
        lock(&self.round).take()
    }

    /// Runs a part that the caller has from the queue; whether it was the last.
    pub(super) fn run_part(&self, worker: usize) -> bool {
        // The beginning of a round is its job's only part.
        if self.begins.swap(false, Ordering::Relaxed) {
            self.left.store(0, Ordering::Release);
            return true;
        }
        self.run(self.claim(worker))
    }

    /// A request has ended.
    pub(super) fn tell(&self) {
        self.ended.fetch_add(1, Ordering::Release);
        self.done.notify_one();
    }

    /// Whether a step is to follow, and which. None is if the pool is `closing`.
    pub(super) fn conduct(&self, closing: bool) -> Continuation {
        if self.failed() || self.abandoned.load(Ordering::Relaxed) {
            lock(&self.follow).stop();
            return Continuation::Nothing;
        }
        let mut round = lock(&self.round);
        let Some(round) = round.as_mut() else {
            drop(round);
            let mut follow = lock(&self.follow);
            if closing {
                follow.stop();
            }
            return self.unless_it_panics(Continuation::Request, || follow.go_on(&self.shards));
        };
        let halted = closing || self.halted.load(Ordering::Relaxed);
        self.unless_it_panics(Continuation::Step, || round.conduct(&self.shards, halted))
    }

    /// `next` if there is to be one.
    fn unless_it_panics(&self, next: Continuation, is_wanted: impl FnOnce() -> bool) -> Continuation {
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

    /// Runs a shard; whether it was the last.
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
        // Release: who sees 0 sees what every shard wrote.
        self.left.fetch_sub(1, Ordering::AcqRel) == 1
    }
}
