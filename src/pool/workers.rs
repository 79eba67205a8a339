//! The worker threads and their queue.

use super::{Error, follow::Follow, round::Round, shard::Shard};
use crate::{
    meters::{Histogram, Meter, Tally},
    priority::lower,
};
use std::{
    collections::{BTreeMap, VecDeque},
    io,
    ops::Range,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicPtr, AtomicU64, AtomicUsize, Ordering},
        mpsc::{self, RecvTimeoutError},
    },
    thread::{self, JoinHandle},
    time::Duration,
};
use tokio::{sync::Notify, time::Instant};

/// How often an idle worker offers its core before it sleeps. A sleeping worker costs the next request a wake-up, which
/// is more than a step of many small environments.
const YIELDS_BEFORE_SLEEP: usize = 100;

/// A job of at most so many µs is done by whoever asks. To have a worker do it takes longer, and no more than one would be
/// set to it.
const TINY: f64 = 20.0;
/// The same for a session that stepped last, too: to hand a job over and to be told of its end costs more, where all
/// cores are awake, than a second worker saves, and no other session waits.
const TINY_ALONE: f64 = 80.0;
/// One of at most so many µs is short, …
const SHORT: f64 = 50.0;
/// … and looked after so often before its session sleeps, about twice that time.
const POLLS: usize = 50;

/// The workers' niceness: the transport, which has little to do at a time, comes before them.
const NICENESS: i32 = 1;
/// That of the thread that frees what sessions leave behind, for which nobody waits.
const NICENESS_OF_FREEING: i32 = 3;

/// Worker threads that step batches, and the count of environments they may hold.
pub struct Pool {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

/// Frees what a session leaves behind, and says whether it could: thousands of environments take longer than the transport
/// may be kept.
pub(super) type Rest = Box<dyn FnMut() -> bool + Send>;
/// How often it is looked whether what could not be freed can be.
const AGAIN: Duration = Duration::from_millis(1);

impl Pool {
    /// Starts `workers` threads (at least 1) for at most `max_environments` environments at a time.
    ///
    /// # Errors
    /// If the operating system starts no thread.
    pub fn new(workers: usize, max_environments: usize) -> io::Result<Self> {
        let (rests, received) = mpsc::channel::<Rest>();
        let shared = Arc::new(Shared {
            rests: Mutex::new(Some(rests)),
            queue: Mutex::new(Queue { jobs: VecDeque::with_capacity(1024), sleeping: 0, closed: false }),
            waiting: AtomicUsize::new(0),
            ready: Condvar::new(),
            closing: AtomicBool::new(false),
            used: AtomicUsize::new(0),
            max_environments,
            changed: Notify::new(),
            last: AtomicPtr::default(),
            meters: Mutex::default(),
            waits: Histogram::default(),
        });
        let mut pool = Self { shared, threads: Vec::new() };
        for i in 0..workers.max(1) {
            let shared = Arc::clone(&pool.shared);
            let thread = thread::Builder::new().name(format!("physics-{i}")).spawn(move || shared.work(i))?;
            pool.threads.push(thread);
        }
        let freeing = move || {
            lower(NICENESS_OF_FREEING);
            free(&received);
        };
        pool.threads.push(thread::Builder::new().name("free".into()).spawn(freeing)?);
        Ok(pool)
    }

    /// The number of worker threads.
    pub fn workers(&self) -> usize {
        self.threads.len() - 1
    }

    /// Environments in use.
    pub fn environments(&self) -> usize {
        self.shared.used.load(Ordering::Relaxed)
    }

    /// The most environments there may be.
    pub fn limit(&self) -> usize {
        self.shared.max_environments
    }

    /// Waits until the number of environments in use has changed since this was last waited for, by one caller.
    pub async fn changed(&self) {
        self.shared.changed.notified().await;
    }

    /// Where what happens in environments of this name is counted.
    pub fn meter(&self, environment: &'static str) -> Arc<Meter> {
        Arc::clone(lock(&self.shared.meters).entry(environment).or_default())
    }

    /// What happened in the environments of each kind that has a meter, by name.
    pub fn meters(&self) -> BTreeMap<&'static str, Arc<Meter>> {
        lock(&self.shared.meters).clone()
    }

    /// How long batches with something to do wait for a worker to take a part of it, each time.
    pub fn waits(&self) -> &Histogram {
        &self.shared.waits
    }

    pub(super) fn queue(&self) -> Arc<Shared> {
        Arc::clone(&self.shared)
    }
}

/// Frees what comes, as soon as it can be, until the pool ends.
fn free(received: &mpsc::Receiver<Rest>) {
    let mut left: Vec<Rest> = Vec::new();
    loop {
        let come = match left.is_empty() {
            true => received.recv().map_err(|_| RecvTimeoutError::Disconnected),
            false => received.recv_timeout(AGAIN),
        };
        match come {
            Ok(rest) => left.push(rest),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
        left.retain_mut(|rest| !rest());
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        self.shared.closing.store(true, Ordering::Relaxed);
        lock(&self.shared.queue).closed = true;
        *lock(&self.shared.rests) = None;
        self.shared.ready.notify_all();
        for thread in self.threads.drain(..) {
            // A worker never panics: shards run inside catch_unwind.
            let _ = thread.join();
        }
    }
}

/// What the workers and the batches share.
pub(super) struct Shared {
    /// The way to the thread that frees, until the pool ends.
    rests: Mutex<Option<mpsc::Sender<Rest>>>,
    queue: Mutex<Queue>,
    /// Jobs in the queue, to be looked at without its lock.
    waiting: AtomicUsize,
    ready: Condvar,
    /// The pool ends: rounds end with their present step.
    closing: AtomicBool,
    used: AtomicUsize,
    max_environments: usize,
    /// Told whenever `used` has changed.
    changed: Notify,
    /// Whose environments moved last; only to be compared.
    last: AtomicPtr<Job>,
    meters: Mutex<BTreeMap<&'static str, Arc<Meter>>>,
    waits: Histogram,
}

struct Queue {
    /// Jobs with the number of their parts, shards or a round's beginning, that nobody has taken, which is never 0, and
    /// since when they are at this place.
    jobs: VecDeque<(Arc<Job>, usize, Instant)>,
    /// Workers that wait for `ready`.
    sleeping: usize,
    closed: bool,
}

impl Shared {
    /// Takes `requested` environments out of the pool's budget until the permit is dropped.
    pub(super) fn reserve(self: &Arc<Self>, requested: usize) -> Result<Permit, Error> {
        let limit = self.max_environments;
        let fits = |used: usize| used.checked_add(requested).filter(|&sum| sum <= limit);
        match self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits) {
            Ok(_) => {
                self.changed.notify_one();
                Ok(Permit { shared: Arc::clone(self), count: AtomicUsize::new(requested) })
            }
            Err(used) => Err(Error::Full { requested, used, limit }),
        }
    }

    fn give_back(&self, environments: usize) {
        self.used.fetch_sub(environments, Ordering::Relaxed);
        self.changed.notify_one();
    }

    /// Steps the environments of every shard here, if that is soon done; whether it was.
    pub(super) fn step_here(&self, job: &Job) -> bool {
        let tiny = if self.moves(job) { TINY_ALONE } else { TINY };
        if job.cost > tiny {
            return false;
        }
        job.prepare();
        (0..job.shards.len()).for_each(|shard| _ = job.run(shard));
        true
    }

    /// Has the workers step the environments of every shard. Another step may follow.
    pub(super) fn begin_step(&self, job: &Arc<Job>) {
        lock(&job.follow).begin();
        self.begin(job);
    }

    /// Runs every shard of the job on the workers and waits for the last: the job's `number`th request.
    pub(super) async fn run(&self, job: &Arc<Job>, number: u64) -> Result<(), Error> {
        self.begin(job);
        self.wait(job, number).await
    }

    fn begin(&self, job: &Arc<Job>) {
        job.prepare();
        let shards = job.shards.len();
        self.push(job, shards, shards); // its lock publishes the job's counters
    }

    /// Runs a round on the workers: its beginning, and whatever steps it wants. Gives it back at its end.
    pub(super) async fn play(&self, job: &Arc<Job>, round: Box<Round>, number: u64) -> Result<Box<Round>, Error> {
        self.moves(job);
        job.prepare_round(round);
        self.push(job, 1, 1);
        self.wait(job, number).await?;
        job.take_round().ok_or(Error::Defect)
    }

    /// Takes note that a job's environments move, and says whether they were the last that did.
    fn moves(&self, job: &Job) -> bool {
        let job = std::ptr::from_ref(job).cast_mut();
        self.last.swap(job, Ordering::Relaxed) == job
    }

    /// Waits until a job's first `number` requests that workers were asked for have ended.
    pub(super) async fn wait(&self, job: &Arc<Job>, number: u64) -> Result<(), Error> {
        let has_ended = || job.ended.load(Ordering::Acquire) >= number;
        // A job that is nearly done is worth more polls than a sleep: being woken costs more than many steps.
        for _ in 0..job.patience {
            if has_ended() {
                break;
            }
            tokio::task::yield_now().await;
        }
        // What told of one end may have been meant for the one before.
        while !has_ended() {
            job.done.notified().await;
        }
        job.result()
    }

    /// Puts a job of so many parts at the queue's tail, and wakes no more than `helpers` workers for them.
    fn push(&self, job: &Arc<Job>, parts: usize, helpers: usize) {
        let now = Instant::now();
        let mut queue = lock(&self.queue);
        queue.jobs.push_back((Arc::clone(job), parts, now));
        self.waiting.store(queue.jobs.len(), Ordering::Release);
        let sleeping = queue.sleeping;
        drop(queue);
        // A wake-up is a system call, also when nobody sleeps.
        match sleeping.min(helpers) {
            0 => {}
            1 => self.ready.notify_one(),
            _ => self.ready.notify_all(),
        }
    }

    /// The job at the queue's head, one part of which is now the caller's. If parts remain the job goes to the tail,
    /// where others find it.
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

    /// Frees what a session leaves behind, elsewhere.
    pub(super) fn free(&self, rest: Rest) {
        if let Some(rests) = &*lock(&self.rests) {
            let _ = rests.send(rest); // its thread ends only with the pool
        }
    }

    fn work(&self, worker: usize) {
        lower(NICENESS);
        while let Some(job) = self.pop() {
            if job.run_part(worker) {
                self.conduct(&job);
            }
        }
    }

    /// A job's last part has ended: its session is told, and another step begins if a round wants one or one follows.
    fn conduct(&self, job: &Arc<Job>) {
        loop {
            let next = job.conduct(self.closing.load(Ordering::Relaxed));
            if matches!(next, Next::Nothing) {
                return job.tell();
            }
            job.prepare();
            let shards = job.shards.len();
            // Others have their turn first. One part is this worker's, which is awake, if nobody waits: through the queue
            // an idle worker would snatch a job that is in this one's cache.
            let is_own = shards == 1 && self.waiting.load(Ordering::Acquire) == 0;
            if !is_own {
                self.push(job, shards, shards - 1);
            }
            if matches!(next, Next::Request) {
                self.moves(job);
                job.tell();
            }
            if !is_own {
                return;
            }
            job.run(0);
        }
    }
}

/// What a job does at a step's end.
enum Next {
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
    round: Mutex<Option<Box<Round>>>,
    /// What is to be done after a step without a round.
    pub(super) follow: Mutex<Follow>,
    /// The part that is to run next is the beginning of the round, not a shard.
    begins: AtomicBool,
    /// Requests that have ended, of those that workers were asked for.
    ended: AtomicU64,
    /// Told whenever one has.
    done: Notify,
    /// The session is gone: what has not run need not.
    pub(super) abandoned: AtomicBool,
    /// Nobody waits for the round any more: it ends with its present step.
    pub(super) halted: AtomicBool,
    failed: AtomicBool,
    /// What a step of all environments takes, µs.
    cost: f64,
    /// How often the session looks whether a request is done before it sleeps until then.
    patience: usize,
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
        follow: Follow,
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
            patience: if cost <= SHORT { POLLS } else { 0 },
            permit,
            tally,
        }
    }

    /// Whether workers step it, whoever else steps.
    pub(super) fn is_for_workers(&self) -> bool {
        self.cost > TINY_ALONE
    }

    /// Whether a worker panicked on it, now or earlier.
    pub(super) fn failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    pub(super) fn result(&self) -> Result<(), Error> {
        if self.failed() { Err(Error::Defect) } else { Ok(()) }
    }

    /// Makes every shard ready to be taken.
    fn prepare(&self) {
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
    fn prepare_round(&self, round: Box<Round>) {
        *lock(&self.round) = Some(round);
        self.halted.store(false, Ordering::Relaxed);
        self.begins.store(true, Ordering::Relaxed);
        self.left.store(1, Ordering::Relaxed);
    }

    /// The round, when it has ended or will never be run.
    pub(super) fn take_round(&self) -> Option<Box<Round>> {
        lock(&self.round).take()
    }

    /// Runs a part that the caller has from the queue; whether it was the last.
    fn run_part(&self, worker: usize) -> bool {
        // The beginning of a round is its job's only part.
        if self.begins.swap(false, Ordering::Relaxed) {
            self.left.store(0, Ordering::Release);
            return true;
        }
        self.run(self.claim(worker))
    }

    /// A request has ended.
    fn tell(&self) {
        self.ended.fetch_add(1, Ordering::Release);
        self.done.notify_one();
    }

    /// Whether a step is to follow, and which. None is if the pool is `closing`.
    fn conduct(&self, closing: bool) -> Next {
        if self.failed() || self.abandoned.load(Ordering::Relaxed) {
            lock(&self.follow).stop();
            return Next::Nothing;
        }
        let mut round = lock(&self.round);
        let Some(round) = round.as_mut() else {
            drop(round);
            let mut follow = lock(&self.follow);
            if closing {
                follow.stop();
            }
            return self.unless_it_panics(Next::Request, || follow.go_on(&self.shards));
        };
        let halted = closing || self.halted.load(Ordering::Relaxed);
        self.unless_it_panics(Next::Step, || round.conduct(&self.shards, halted))
    }

    /// `next` if there is to be one.
    fn unless_it_panics(&self, next: Next, is_wanted: impl FnOnce() -> bool) -> Next {
        match catch_unwind(AssertUnwindSafe(is_wanted)) {
            Ok(true) => next,
            Ok(false) => Next::Nothing,
            Err(_) => {
                tracing::error!("a worker panicked between two steps; the batch is lost");
                self.failed.store(true, Ordering::Relaxed);
                Next::Nothing
            }
        }
    }

    /// Runs a shard; whether it was the last.
    fn run(&self, index: usize) -> bool {
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

/// A part of the pool's budget of environments.
pub(super) struct Permit {
    shared: Arc<Shared>,
    count: AtomicUsize,
}

impl Permit {
    /// Gives back so many environments, which must not be more than there are.
    pub(super) fn give_back(&self, count: usize) {
        self.count.fetch_sub(count, Ordering::Relaxed);
        self.shared.give_back(count);
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.shared.give_back(*self.count.get_mut());
    }
}

/// Locks, also after a panic: a batch whose worker panicked is refused by its `failed` flag.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
