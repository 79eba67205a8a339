//! The environments of a session. A request runs on the pool's workers, or on the session's thread if it is cheap. Its
//! outputs are gathered into a reply.

use super::{
    Error,
    capacity::Permit,
    encode::push_f32,
    job::Job,
    pipelined_step::PipelinedStep,
    rollout::{
        policy_runner::PolicyRunner,
        task::{Rollout, RolloutRequest, RolloutTask},
    },
    scheduler::{Pool, StepScheduler},
    settings::{Autoreset, BatchSettings, SlotGroupSettings},
    shard::{Command, Shard, SlotReset, set_actions},
    step_queue::StepQueue,
    step_result::{ShardOutputs, StepResult, collect},
    sync::lock,
};
use crate::{
    env::{Distribution, Draw, EnvironmentSpec, Episodes, StartedEpisode, distributions_bytes, disturbance},
    meters::Tally,
    scene::Scene,
};
use bytes::{Bytes, BytesMut};
use std::{
    ops::RangeInclusive,
    sync::{Arc, Mutex, atomic::Ordering},
};
use tokio::{sync::oneshot, time::Instant};

/// The minimum and maximum cost of a step of one shard, µs. The minimum makes the overhead of the queue small in
/// comparison. The maximum lets other sessions use the worker soon.
const SHARD_COST_US: RangeInclusive<f64> = 20.0..=200.0;
/// The intended number of shards for each worker, so that all workers finish at about the same time. The limits of
/// [`SHARD_COST_US`] take precedence.
const SHARDS_PER_WORKER: f64 = 32.0;
/// The minimum cost of each worker's part of a batch's step, µs. A cheaper batch is not split among all workers.
const MIN_WORKER_SHARE_US: f64 = 10.0;
/// The maximum number of environments in a batch that is freed on the transport thread. Larger batches are freed by the
/// reaper's thread, since freeing them would block the transport thread for too long.
const INLINE_DROP_MAX_ENVS: usize = 64;

/// The reset of one environment. It begins a new episode. If there is a new seed or new distributions, it also begins a
/// new trial.
#[derive(Debug, Clone, PartialEq)]
pub struct ResetEntry {
    /// The environment's slot in the batch.
    pub slot: usize,
    /// A new seed; `None` keeps the seed.
    pub seed: Option<u64>,
    /// New distributions, one for each parameter in each box, in the layout of
    /// [`EpisodeSettings::distributions`](crate::env::EpisodeSettings::distributions). `None` keeps the distributions.
    pub distributions: Option<Arc<[Distribution]>>,
    /// An exact initial state, `[S]`, finite; `None` draws the initial state.
    pub state: Option<Vec<f64>>,
}

/// The environments of a session. Dropping the batch frees them as soon as no worker runs them.
pub struct Batch {
    settings: BatchSettings,
    /// N, the number of environments.
    size: usize,
    shard_size: usize,
    job: Arc<Job>,
    workers: Arc<StepScheduler>,
    n_workers: usize,
    buffer: BytesMut,
    /// The number of requests of the present `job` that were passed to the workers so far.
    n_requests: u64,
    /// Whether a request was passed to the workers and the session has not yet seen its end.
    is_running: bool,
    /// If the next request is a pipelined step that has already started: its start time.
    pipelined_since: Option<Instant>,
    /// The policy of the last [`Batch::act`]. Any other request that changes the environments drops it.
    runner: Option<Box<PolicyRunner>>,
    /// Runs when the environments are freed.
    drop_hook: Option<DropHook>,
    /// Whether environments may have noise, whose random numbers can be drawn ahead.
    has_noise: bool,
    /// Whether the last request was a step that ran on the session's thread.
    stepped_inline: bool,
    /// A sender that is dropped when the environments have been freed, for which [`Batch::close`] waits. It must be the
    /// last field, because fields are dropped in order.
    freed: Option<oneshot::Sender<()>>,
}

/// A hook that runs when a batch's environments are freed. Its argument has the seed, environment index and episode
/// index of each environment's last episode, in order of slots.
pub type DropHook = Box<dyn FnOnce(Vec<Draw>) + Send + Sync>;

impl Batch {
    /// Creates the environments on the pool's workers, and begins their first episodes. Returns the batch, the first
    /// observations, f32 `[N, O]`, and, if the settings have receipts, the episodes that began.
    ///
    /// # Errors
    /// [`Error::Full`] if the pool has no room, [`Error::Environment`] if a model cannot be loaded.
    pub async fn open(
        pool: &Pool,
        settings: BatchSettings,
    ) -> Result<(Self, Bytes, Vec<(u32, StartedEpisode)>), Error> {
        let (workers, size) = (pool.queue(), settings.size());
        let owned = (Arc::new(workers.capacity.reserve(size)?), Arc::new(Tally::new(pool.meter(settings.spec.name))));
        let shard_size = shard_size(settings.spec, size, pool.workers());
        let parts = cut(&settings.groups, shard_size).into_iter().enumerate();
        let shard = |(i, part)| Mutex::new(Shard::new(&settings, part, i * shard_size));
        let shards = parts.map(shard).collect();
        let job = job(&settings, shards, pool.workers(), owned, size);
        let is_noisy = |group: &SlotGroupSettings| disturbance::has_noise(settings.spec, &group.episodes.distributions);
        let has_noise = settings.groups.iter().any(is_noisy);
        let mut batch = Self {
            settings,
            size,
            shard_size,
            job,
            workers,
            n_workers: pool.workers(),
            buffer: BytesMut::new(),
            n_requests: 0,
            is_running: false,
            pipelined_since: None,
            runner: None,
            drop_hook: None,
            has_noise,
            stepped_inline: false,
            freed: None,
        };
        batch.run().await?;
        batch.check_failures()?;
        let observations = batch.gather().observations();
        let started = collect(&batch.job.shards, |shard| &mut shard.started);
        Ok((batch, observations, started))
    }

    /// The settings with which the batch was opened.
    pub fn settings(&self) -> &BatchSettings {
        &self.settings
    }

    /// N, the number of environments. Released environments do not count.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The number of steps so far, summed over the environments.
    pub fn steps(&self) -> u64 {
        self.job.tally.steps()
    }

    /// Advances every environment by one step. `actions` are little-endian: for a discrete space i32 `[N]`, each a
    /// valid choice; for a continuous space f32 `[N, A]`, finite. The caller must have checked them.
    ///
    /// # Errors
    /// [`Error::Ended`] if autoreset is disabled and an episode has ended, [`Error::Defect`] if a worker panicked.
    pub async fn step(&mut self, actions: &[u8]) -> Result<StepResult, Error> {
        let start = match self.pipelined_since.take() {
            Some(start) => start,
            None => {
                self.ready().await?;
                if self.settings.autoreset == Autoreset::Disabled {
                    self.refuse_ended()?;
                }
                let start = Instant::now();
                self.runner = None;
                set_actions(&self.job.shards, actions);
                if self.workers.step_inline(&self.job) {
                    self.stepped_inline = true;
                    self.job.result()?;
                    return Ok(self.step_result(start, Instant::now()));
                }
                self.workers.begin_step(&self.job);
                start
            }
        };
        let number = self.next_request();
        let ended = self.workers.wait(&self.job, number).await;
        self.is_running = false;
        // If a pipelined step followed this step, the worker has already gathered the result of this step.
        let (gathered, end) = {
            let mut pipelined = lock(&self.job.pipelined);
            (pipelined.take_result(), pipelined.ended_at())
        };
        self.pipelined_since = gathered.as_ref().map(|(_, begun)| *begun);
        ended?;
        match gathered {
            Some((stepped, end)) => {
                self.observe(start, end);
                Ok(stepped)
            }
            None => Ok(self.step_result(start, end.unwrap_or_else(Instant::now))),
        }
    }

    /// Whether [`Batch::draw_ahead`] can make the next step faster. If the workers ran the last step, drawing ahead on
    /// this thread would only delay other sessions.
    pub fn draws_ahead(&self) -> bool {
        self.has_noise && self.stepped_inline
    }

    /// Draws the random numbers of the next step's noise on the calling thread. Call this method while the session waits
    /// for a request, if [`Batch::draws_ahead`] is true. Results do not depend on it.
    pub fn draw_ahead(&mut self) {
        self.job.shards.iter().for_each(|shard| lock(shard).draw_ahead());
    }

    /// Gathers the result of the step that ran from `start` to `end`.
    fn step_result(&mut self, start: Instant, end: Instant) -> StepResult {
        self.observe(start, end);
        let reward_terms = self.settings.reward_terms;
        self.gather().step_result(reward_terms)
    }

    fn observe(&self, start: Instant, end: Instant) {
        self.job.tally.meter.times(self.size).observe(end.saturating_duration_since(start));
    }

    /// Returns a handle to queue the next step while a step is running. Returns `None` if the client must see a step's
    /// result before it sends the next step, or if steps may run on the session's own thread.
    pub fn step_queue(&self) -> Option<StepQueue> {
        let (job, spec, size) = (Arc::clone(&self.job), self.settings.spec, self.size);
        let follows = self.settings.autoreset != Autoreset::Disabled && job.needs_workers();
        follows.then_some(StepQueue { job, spec, size })
    }

    /// Lets a policy play several steps. If `request` has no policy, the previous policy continues. If `request` has no
    /// task, the previous task continues. The caller must have checked that there is a policy, that a new task does not
    /// replace an unfinished one, that the mode is [`Autoreset::SameStep`], and that policy and weights fit the batch.
    ///
    /// # Errors
    /// [`Error::Policy`] if an input or an output of the policy is not finite, [`Error::Defect`] if a worker panicked.
    /// After an error, the next call needs a new policy.
    pub async fn act(&mut self, request: RolloutRequest) -> Result<Rollout, Error> {
        self.ready().await?;
        let task = Box::new(RolloutTask::new(request, self.runner.take()));
        let number = self.next_request();
        let task = self.workers.run_rollout(&self.job, task, number).await;
        self.is_running = false;
        let (runner, rollout) = task?.finish()?;
        self.runner = runner;
        Ok(rollout)
    }

    /// The policy that the next rollout continues, or `None` if the next rollout must bring a new policy.
    pub fn policy_runner(&self) -> Option<&PolicyRunner> {
        self.runner.as_deref()
    }

    /// Frees the environments in `slots`, which must be sorted in ascending order. At least one environment must
    /// remain. The remaining environments are renumbered from slot 0, and unchanged otherwise.
    ///
    /// # Errors
    /// [`Error::Defect`], if a worker panicked.
    pub async fn release(&mut self, slots: &[usize]) -> Result<(), Error> {
        self.ready().await?;
        self.runner = None;
        let mut is_released = vec![false; self.size];
        slots.iter().for_each(|&slot| is_released[slot] = true);
        let mut all = self.job.shards.iter().flat_map(|shard| lock(shard).take_slots()).collect::<Vec<Episodes>>();
        let mut slot = 0..;
        let released: Vec<Episodes> =
            all.extract_if(.., |_| slot.next().is_some_and(|slot: usize| is_released[slot])).collect();
        let mut released = Some(released);
        self.workers.reaper.drop_later(Box::new(move || {
            drop(released.take());
            true
        }));
        self.size = all.len();
        self.shard_size = shard_size(self.settings.spec, self.size, self.n_workers);
        let mut shards = Vec::new();
        for first in (0..self.size).step_by(self.shard_size) {
            let part: Vec<Episodes> = all.drain(..self.shard_size.min(all.len())).collect();
            let size = part.len();
            shards.push(Mutex::new(Shard::with_environments(&self.settings, part, (first, size))));
        }
        let owned = (Arc::clone(&self.job.permit), Arc::clone(&self.job.tally));
        self.job.permit.release(slots.len());
        self.job = job(&self.settings, shards, self.n_workers, owned, self.size);
        self.n_requests = 0;
        Ok(())
    }

    /// Begins new episodes in some environments. `entries` must be sorted by slot, ascending. Returns the first
    /// observations of the M episodes, f32 `[M, O]`, and, if the settings have receipts, the episodes that began.
    ///
    /// # Errors
    /// [`Error::Defect`], if a worker panicked.
    pub async fn reset(&mut self, entries: Vec<ResetEntry>) -> Result<(Bytes, Vec<(u32, StartedEpisode)>), Error> {
        self.ready().await?;
        let slots: Vec<usize> = entries.iter().map(|entry| entry.slot).collect();
        let commands = self.split(entries, |entry| entry.slot);
        self.command(commands, |first, entries| {
            let local = |ResetEntry { slot, seed, distributions, state }| SlotReset {
                slot: slot - first,
                seed,
                distributions,
                state,
            };
            Command::Reset(entries.into_iter().map(local).collect())
        });
        self.runner = None;
        match self.workers.reset_inline(&self.job) {
            true => self.job.result()?,
            false => self.run().await?,
        }
        Ok((self.observations(&slots), collect(&self.job.shards, |shard| &mut shard.started)))
    }

    /// Returns a snapshot of each environment in `slots`, which must be sorted in ascending order.
    ///
    /// # Errors
    /// [`Error::Defect`], if a worker panicked.
    pub async fn snapshot(&mut self, slots: Vec<usize>) -> Result<Vec<Bytes>, Error> {
        self.ready().await?;
        let commands = self.split(slots, |&slot| slot);
        self.command(commands, |first, slots| Command::Snapshot(slots.iter().map(|slot| slot - first).collect()));
        self.run().await?;
        Ok(collect(&self.job.shards, |shard| &mut shard.snapshots).into_iter().map(Bytes::from).collect())
    }

    /// Restores the environments in some slots from snapshots. `entries` must be sorted by slot, ascending. If an
    /// environment cannot be restored, none is changed. Returns the observations of the M restored environments,
    /// f32 `[M, O]`.
    ///
    /// # Errors
    /// [`Error::Environment`] if a snapshot cannot be restored, [`Error::Defect`] if a worker panicked.
    pub async fn restore(&mut self, entries: Vec<(usize, Bytes)>) -> Result<Bytes, Error> {
        self.ready().await?;
        let slots: Vec<usize> = entries.iter().map(|entry| entry.0).collect();
        let commands = self.split(entries, |entry| entry.0);
        self.command(commands, |first, entries| {
            Command::Restore(entries.into_iter().map(|(slot, snapshot)| (slot - first, snapshot)).collect())
        });
        self.run().await?;
        if let Err(refused) = self.check_failures() {
            self.command(Vec::new(), |_, _: Vec<()>| Command::RollBack);
            self.run().await?;
            self.check_failures()?;
            return Err(refused);
        }
        self.runner = None;
        Ok(self.observations(&slots))
    }

    /// Returns the current distributions of a slot's environment, one for each parameter in each box.
    pub fn distributions(&self, slot: usize) -> Arc<[Distribution]> {
        lock(&self.job.shards[slot / self.shard_size]).distributions(slot)
    }

    /// Returns the seed, environment index and episode index of the current episode in a slot.
    pub fn draw(&self, slot: usize) -> Draw {
        lock(&self.job.shards[slot / self.shard_size]).draw(slot)
    }

    /// Sets the hook that runs when the environments are freed.
    pub fn when_freed(&mut self, hook: DropHook) {
        self.drop_hook = Some(hook);
    }

    /// Frees the environments. Resolves when they are freed and the pool has room for others.
    pub fn close(mut self) -> impl Future<Output = ()> + Send + use<> {
        let (freed, is_freed) = oneshot::channel();
        self.freed = Some(freed);
        drop(self);
        async move {
            let _ = is_freed.await; // resolves with an error when the sender is dropped
        }
    }

    /// Waits for the end of a request whose future was dropped before it resolved. Call this method before the next
    /// request, because workers may still be running the old request. A queued step that has not started is dropped,
    /// and a rollout ends after its current step.
    pub async fn finish_abandoned(&mut self) {
        // Errors are ignored here: the next request reports them.
        if self.is_running {
            self.job.is_halted.store(true, Ordering::Relaxed);
            lock(&self.job.pipelined).stop();
            let _ = self.workers.wait(&self.job, self.n_requests).await;
            self.job.take_rollout();
            self.is_running = false;
            self.pipelined_since = lock(&self.job.pipelined).take_result().map(|(_, begun)| begun);
        }
        if self.pipelined_since.take().is_some() {
            let number = self.next_request();
            let _ = self.workers.wait(&self.job, number).await;
            self.is_running = false;
        }
    }

    /// Returns the scene to draw of a slot's environment, or `None` if its physics diverged. The calling thread reads
    /// the scene itself: no request is running, and reading is cheap.
    ///
    /// # Errors
    /// [`Error::Defect`], if a worker panicked.
    pub fn scene(&self, slot: usize) -> Result<Option<Scene>, Error> {
        if self.job.failed() {
            return Err(Error::Defect);
        }
        Ok(lock(&self.job.shards[slot / self.shard_size]).scene(slot))
    }

    /// Returns an upper bound of the length of each environment's snapshot, bytes. The bound holds until a reset or a
    /// restore replaces a distribution by a distribution with more intervals.
    pub fn max_snapshot_bytes(&self) -> usize {
        let own = lock(&self.job.shards[0]).max_snapshot_bytes();
        let distributions = |group: &SlotGroupSettings| distributions_bytes(&*group.episodes.distributions);
        let largest = self.settings.groups.iter().map(distributions).max().unwrap_or_default();
        own + largest
    }

    /// Prepares for a request other than a pipelined step: waits until no request is running, and checks that none has
    /// failed.
    async fn ready(&mut self) -> Result<(), Error> {
        self.stepped_inline = false;
        self.finish_abandoned().await;
        self.job.result()
    }

    async fn run(&mut self) -> Result<(), Error> {
        let number = self.next_request();
        let result = self.workers.run(&self.job, number).await;
        self.is_running = false;
        result
    }

    /// Counts a request that is passed to the workers now. Returns its number.
    fn next_request(&mut self) -> u64 {
        self.is_running = true;
        self.n_requests += 1;
        self.n_requests
    }

    fn check_failures(&self) -> Result<(), Error> {
        let failure = self.job.shards.iter().find_map(|shard| lock(shard).failure.clone());
        failure.map_or(Ok(()), |error| Err(error.into()))
    }

    fn refuse_ended(&self) -> Result<(), Error> {
        const MAX_SHOWN_SLOTS: usize = 8;
        let mut ended: Vec<String> = Vec::new();
        for shard in &self.job.shards {
            ended.extend(lock(shard).ended_slots().map(|slot| slot.to_string()));
        }
        if ended.is_empty() {
            return Ok(());
        }
        let more = ended.len().saturating_sub(MAX_SHOWN_SLOTS);
        ended.truncate(MAX_SHOWN_SLOTS);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        Err(Error::Ended { slots: ended.join(", ") + &more })
    }

    /// Splits entries into one list for each shard. `slot_of` returns the slot of an entry.
    fn split<T>(&self, entries: Vec<T>, slot_of: impl Fn(&T) -> usize) -> Vec<Vec<T>> {
        let mut lists: Vec<Vec<T>> = self.job.shards.iter().map(|_| Vec::new()).collect();
        for entry in entries {
            lists[slot_of(&entry) / self.shard_size].push(entry);
        }
        lists
    }

    /// Gives each shard a command. `lists` has a list for each shard; `make` makes the command from the shard's first
    /// slot and its list.
    fn command<T>(&self, lists: Vec<Vec<T>>, make: impl Fn(usize, Vec<T>) -> Command) {
        let mut lists = lists.into_iter();
        for shard in &self.job.shards {
            let mut shard = lock(shard);
            shard.command = make(shard.first_slot, lists.next().unwrap_or_default());
        }
    }

    fn observations(&mut self, slots: &[usize]) -> Bytes {
        let n = self.settings.observation_size();
        for &slot in slots {
            let shard = lock(&self.job.shards[slot / self.shard_size]);
            push_f32(&mut self.buffer, &shard.observations[(slot - shard.first_slot) * n..][..n]);
        }
        self.buffer.split().freeze()
    }

    fn gather(&mut self) -> ShardOutputs<'_> {
        ShardOutputs { shards: &self.job.shards, buffer: &mut self.buffer }
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        self.job.abandoned.store(true, Ordering::Relaxed);
        let is_idle = Arc::strong_count(&self.job) == 1;
        let may_end_later = self.drop_hook.is_none() && self.freed.is_none();
        if self.size() <= INLINE_DROP_MAX_ENVS && (is_idle || may_end_later) {
            if let Some(hook) = self.drop_hook.take() {
                hook(draws(&self.job));
            }
            // If no worker uses the environments, they are freed here, so the pool has room immediately. Otherwise the
            // last worker that uses them frees them.
            return;
        }
        // The last owner of the job frees the environments. The reaper becomes this owner, so that neither this thread
        // nor a worker is blocked.
        let mut deferred = Some((Arc::clone(&self.job), self.runner.take(), self.drop_hook.take(), self.freed.take()));
        self.workers.reaper.drop_later(Box::new(move || {
            let is_alone = deferred.as_ref().is_none_or(|(job, ..)| Arc::strong_count(job) == 1);
            if let Some((job, runner, drop_hook, freed)) = deferred.take_if(|_| is_alone) {
                if let Some(hook) = drop_hook {
                    hook(draws(&job));
                }
                drop((job, runner));
                drop(freed); // after the environments are freed
            }
            is_alone
        }));
    }
}

/// Returns the seed, environment index and episode index of the current episode in each slot of a job.
fn draws(job: &Job) -> Vec<Draw> {
    job.shards.iter().flat_map(|shard| lock(shard).draws().collect::<Vec<_>>()).collect()
}

/// Makes the job that the workers run for a batch of `size` environments.
fn job(
    settings: &BatchSettings,
    shards: Vec<Mutex<Shard>>,
    workers: usize,
    owned: (Arc<Permit>, Arc<Tally>),
    size: usize,
) -> Arc<Job> {
    let (cost, pipelined) = (settings.spec.step_cost * size as f64, PipelinedStep::new(settings.reward_terms));
    Arc::new(Job::new(shards, workers, owned, cost, pipelined))
}

/// Divides the slots of `groups` into parts of `size` slots each. The last part may have fewer.
fn cut(groups: &[SlotGroupSettings], size: usize) -> Vec<Vec<SlotGroupSettings>> {
    let (mut parts, mut part, mut free_slots) = (Vec::new(), Vec::new(), size);
    for group in groups {
        let mut remaining = group.clone();
        while remaining.size > 0 {
            let taken = remaining.size.min(free_slots);
            part.push(SlotGroupSettings { size: taken, ..remaining.clone() });
            remaining.size -= taken;
            // The index may overflow if no slot of the group remains, but then the index is never used.
            remaining.episodes.environment_index = remaining.episodes.environment_index.wrapping_add(taken as u32);
            free_slots -= taken;
            if free_slots == 0 {
                parts.push(std::mem::take(&mut part));
                free_slots = size;
            }
        }
    }
    parts.extend((!part.is_empty()).then_some(part));
    parts
}

/// Returns the number of environments in a shard, at least 1, of a batch of `batch` environments. The cost of a shard's
/// step is about within [`SHARD_COST_US`], with two exceptions. A single environment may cost more. If a worker's
/// equal share of the batch costs at least [`MIN_WORKER_SHARE_US`], a shard has at most this share, and may cost less.
fn shard_size(spec: &EnvironmentSpec, batch: usize, workers: usize) -> usize {
    let by_workers = batch.div_ceil(workers);
    let share = spec.step_cost * by_workers as f64;
    let cost = (share / SHARDS_PER_WORKER).clamp(*SHARD_COST_US.start(), *SHARD_COST_US.end());
    let by_cost = (cost / spec.step_cost).ceil() as usize;
    if share >= MIN_WORKER_SHARE_US { by_cost.min(by_workers).max(1) } else { by_cost.max(1) }
}
