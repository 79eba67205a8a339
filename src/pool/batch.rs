//! A session's environments: requests in, gathered replies out.

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
    settings::{Autoreset, BatchSettings, SlotGroup},
    shard::{Command, Shard, SlotReset, set_actions},
    step_queue::StepQueue,
    step_result::{ShardOutputs, StepResult, collect},
    sync::lock,
};
use crate::{
    env::{Distribution, Draw, EnvironmentSpec, EpisodeStart, Episodes, distributions_bytes},
    meters::Tally,
    scene::Scene,
};
use bytes::{Bytes, BytesMut};
use std::{
    ops::RangeInclusive,
    sync::{Arc, Mutex, atomic::Ordering},
};
use tokio::{sync::oneshot, time::Instant};

/// The cost of a step of one shard, µs: large compared with the overhead of the queue, but small enough that sessions
/// take turns.
const SHARD_COST_US: RangeInclusive<f64> = 20.0..=200.0;
/// The number of shards for each worker, so that workers finish together. There are fewer if these would be too cheap.
const SHARDS_PER_WORKER: f64 = 32.0;
/// The minimum cost of one worker's share, µs, at which a batch is split among the workers.
const MIN_WORKER_SHARE_US: f64 = 10.0;
/// Batches of at most this many environments are freed on the transport's thread, because this takes only a moment.
const INLINE_DROP_MAX_ENVS: usize = 64;

/// The reset of one environment. It begins a new episode, and with a seed or distributions also a new trial.
#[derive(Debug, Clone, PartialEq)]
pub struct ResetEntry {
    /// The slot in the batch.
    pub slot: usize,
    /// A new seed.
    pub seed: Option<u64>,
    /// New distributions, one for each parameter.
    pub distributions: Option<Arc<[Distribution]>>,
    /// An exact initial state, `[S]`, finite.
    pub state: Option<Vec<f64>>,
}

/// A batch of environments. Dropping the batch frees them at once, or as soon as the running shards have finished.
pub struct Batch {
    settings: BatchSettings,
    /// N.
    size: usize,
    shard_size: usize,
    job: Arc<Job>,
    workers: Arc<StepScheduler>,
    n_workers: usize,
    buffer: BytesMut,
    /// The number of requests that were handed to the workers.
    n_requests: u64,
    /// Whether a request was handed to the workers and its end has not been awaited.
    under_way: bool,
    /// The start time of the next request, if it is a pipelined step.
    pipelined_since: Option<Instant>,
    /// The playing policy, until a request other than `act` changes the environments.
    runner: Option<Box<PolicyRunner>>,
    /// The hook that runs when the environments are freed.
    drop_hook: Option<DropHook>,
    /// Dropped when the environments are freed, which [`Batch::close`] waits for. As the last field it is dropped last.
    freed: Option<oneshot::Sender<()>>,
}

/// A hook that runs when the environments are freed. It gets their draws, in order of slots.
pub type DropHook = Box<dyn FnOnce(Vec<Draw>) + Send + Sync>;

impl Batch {
    /// Makes the environments, on the pool's workers, and begins their first episodes. Returns the batch with its first
    /// observations, f32 `[N, O]`, and the episodes begun (only with receipts).
    ///
    /// # Errors
    /// [`Error::Full`], or [`Error::Environment`] if a model cannot be loaded.
    pub async fn open(pool: &Pool, settings: BatchSettings) -> Result<(Self, Bytes, Vec<(u32, EpisodeStart)>), Error> {
        let (workers, size) = (pool.queue(), settings.size());
        let owned = (Arc::new(workers.capacity.reserve(size)?), Arc::new(Tally::new(pool.meter(settings.spec.name))));
        let shard_size = shard_size(settings.spec, size, pool.workers());
        let parts = cut(&settings.groups, shard_size).into_iter().enumerate();
        let shard = |(i, part)| Mutex::new(Shard::new(&settings, part, i * shard_size));
        let shards = parts.map(shard).collect();
        let job = job(&settings, shards, pool.workers(), owned, size);
        let mut batch = Self {
            settings,
            size,
            shard_size,
            job,
            workers,
            n_workers: pool.workers(),
            buffer: BytesMut::new(),
            n_requests: 0,
            under_way: false,
            pipelined_since: None,
            runner: None,
            drop_hook: None,
            freed: None,
        };
        batch.run().await?;
        batch.check_failures()?;
        let observations = batch.gather().observations();
        let started = collect(&batch.job.shards, |shard| &mut shard.started);
        Ok((batch, observations, started))
    }

    /// The settings of the batch.
    pub fn settings(&self) -> &BatchSettings {
        &self.settings
    }

    /// N: the number of environments, without those that were released.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Steps of an environment so far.
    pub fn steps(&self) -> u64 {
        self.job.tally.steps()
    }

    /// Advances every environment by one step. Discrete actions are i32 `[N]`, each a choice of the space; continuous
    /// ones f32 `[N, A]`, finite: the caller has checked them.
    ///
    /// # Errors
    /// [`Error::Ended`] in [`Autoreset::Disabled`], [`Error::Defect`].
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
                    self.job.result()?;
                    return Ok(self.step_result(start, Instant::now()));
                }
                self.workers.begin_step(&self.job);
                start
            }
        };
        let number = self.next_request();
        let ended = self.workers.wait(&self.job, number).await;
        self.under_way = false;
        // If a pipelined step followed at once, the worker has already gathered the result.
        let (pipelined_since, end) = {
            let mut pipelined = lock(&self.job.pipelined);
            (pipelined.take_result(), pipelined.ended_at())
        };
        self.pipelined_since = pipelined_since.as_ref().map(|(_, begun)| *begun);
        ended?;
        match pipelined_since {
            Some((stepped, end)) => {
                self.observe(start, end);
                Ok(stepped)
            }
            None => Ok(self.step_result(start, end.unwrap_or_else(Instant::now))),
        }
    }

    /// The result of the step that has ended.
    fn step_result(&mut self, start: Instant, end: Instant) -> StepResult {
        self.observe(start, end);
        let reward_terms = self.settings.reward_terms;
        self.gather().step_result(reward_terms)
    }

    fn observe(&self, start: Instant, end: Instant) {
        self.job.tally.meter.times(self.size).observe(end.saturating_duration_since(start));
    }

    /// Returns the queue for a pipelined step. Returns `None` if the client must see the result of a step before the
    /// next one, or if steps may run on the session's own thread.
    pub fn step_queue(&self) -> Option<StepQueue> {
        let (job, spec, size) = (Arc::clone(&self.job), self.settings.spec, self.size);
        let follows = self.settings.autoreset != Autoreset::Disabled && job.needs_workers();
        follows.then_some(StepQueue { job, spec, size })
    }

    /// Runs a rollout of a policy. Without a new policy the previous one continues, and without a new task the previous
    /// task. The caller has checked that there is a policy, that the previous task is done if another begins, that the
    /// mode is [`Autoreset::SameStep`], and that policy and weights fit.
    ///
    /// # Errors
    /// [`Error::Policy`] if numbers are not finite, [`Error::Defect`]. After either the next call needs a new policy.
    pub async fn act(&mut self, turn: RolloutRequest) -> Result<Rollout, Error> {
        self.ready().await?;
        let task = Box::new(RolloutTask::new(turn, self.runner.take()));
        let number = self.next_request();
        let task = self.workers.run_rollout(&self.job, task, number).await;
        self.under_way = false;
        let (runner, played) = task?.finish()?;
        self.runner = runner;
        Ok(played)
    }

    /// The playing policy, if there is one.
    pub fn policy_runner(&self) -> Option<&PolicyRunner> {
        self.runner.as_deref()
    }

    /// Frees the environments in these slots, which are in order. At least one environment stays. The others move to
    /// the slots from 0 on and are unchanged otherwise.
    ///
    /// # Errors
    /// [`Error::Defect`].
    pub async fn release(&mut self, slots: &[usize]) -> Result<(), Error> {
        self.ready().await?;
        self.runner = None;
        let mut is_released = vec![false; self.size];
        slots.iter().for_each(|&slot| is_released[slot] = true);
        let mut all = self.job.shards.iter().flat_map(|shard| lock(shard).take_slots()).collect::<Vec<Episodes>>();
        let mut slot = 0..;
        let gone: Vec<Episodes> =
            all.extract_if(.., |_| slot.next().is_some_and(|slot: usize| is_released[slot])).collect();
        let mut gone = Some(gone);
        self.workers.reaper.drop_later(Box::new(move || {
            drop(gone.take());
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

    /// Begins new episodes, in order of slots. Returns their first observations, f32 `[M, O]`, and, with receipts, the
    /// episodes.
    ///
    /// # Errors
    /// [`Error::Defect`].
    pub async fn reset(&mut self, entries: Vec<ResetEntry>) -> Result<(Bytes, Vec<(u32, EpisodeStart)>), Error> {
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

    /// Saves environments, in order of slots.
    ///
    /// # Errors
    /// [`Error::Defect`].
    pub async fn snapshot(&mut self, slots: Vec<usize>) -> Result<Vec<Bytes>, Error> {
        self.ready().await?;
        let commands = self.split(slots, |&slot| slot);
        self.command(commands, |first, slots| Command::Snapshot(slots.iter().map(|slot| slot - first).collect()));
        self.run().await?;
        Ok(collect(&self.job.shards, |shard| &mut shard.snapshots).into_iter().map(Bytes::from).collect())
    }

    /// Restores environments, in order of slots: all, or none if one cannot be. Returns their observations, f32
    /// `[M, O]`.
    ///
    /// # Errors
    /// [`Error::Environment`] for a snapshot that cannot be restored, [`Error::Defect`].
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

    /// The present distributions of a slot, one for each parameter.
    pub fn distributions(&self, slot: usize) -> Vec<Distribution> {
        lock(&self.job.shards[slot / self.shard_size]).distributions(slot).to_vec()
    }

    /// The address of a slot's draws: seed, environment and episode.
    pub fn draw(&self, slot: usize) -> Draw {
        lock(&self.job.shards[slot / self.shard_size]).draw(slot)
    }

    /// Sets the hook that runs when the environments are freed. It gets their draws, in order of slots.
    pub fn when_freed(&mut self, hook: DropHook) {
        self.drop_hook = Some(hook);
    }

    /// Frees the environments. Resolves when they are freed and others have room.
    pub fn close(mut self) -> impl Future<Output = ()> + Send + use<> {
        let (freed, is_freed) = oneshot::channel();
        self.freed = Some(freed);
        drop(self);
        async move {
            let _ = is_freed.await; // the sender's end is the answer
        }
    }

    /// Waits for a request whose future was dropped early. Call it before the next request: workers may still be
    /// running the old one and a step queued behind it. A rollout ends with its present step.
    pub async fn finish_abandoned(&mut self) {
        // The next request reports a failure of the abandoned one.
        if self.under_way {
            self.job.is_halted.store(true, Ordering::Relaxed);
            lock(&self.job.pipelined).stop();
            let _ = self.workers.wait(&self.job, self.n_requests).await;
            self.job.take_rollout();
            self.under_way = false;
            self.pipelined_since = lock(&self.job.pipelined).take_result().map(|(_, begun)| begun);
        }
        if self.pipelined_since.take().is_some() {
            let number = self.next_request();
            let _ = self.workers.wait(&self.job, number).await;
            self.under_way = false;
        }
    }

    /// Returns the scene of a slot, or `None` if its physics diverged. It is read on the calling thread, because no
    /// request runs and little is read.
    ///
    /// # Errors
    /// [`Error::Defect`].
    pub fn scene(&self, slot: usize) -> Result<Option<Scene>, Error> {
        if self.job.failed() {
            return Err(Error::Defect);
        }
        Ok(lock(&self.job.shards[slot / self.shard_size]).scene(slot))
    }

    /// Returns an upper bound of the length of each environment's snapshot, in bytes. It holds until a distribution is
    /// replaced by one of more intervals.
    pub fn max_snapshot_bytes(&self) -> usize {
        let own = lock(&self.job.shards[0]).max_snapshot_bytes();
        let distributions = |group: &SlotGroup| distributions_bytes(&group.episodes.distributions);
        let largest = self.settings.groups.iter().map(distributions).max().unwrap_or_default();
        own + largest
    }

    /// Prepares for a request other than a pipelined step: waits until none runs, and checks that none has failed.
    async fn ready(&mut self) -> Result<(), Error> {
        self.finish_abandoned().await;
        self.job.result()
    }

    async fn run(&mut self) -> Result<(), Error> {
        let number = self.next_request();
        let result = self.workers.run(&self.job, number).await;
        self.under_way = false;
        result
    }

    /// Counts a request that is handed to the workers now. Returns its number.
    fn next_request(&mut self) -> u64 {
        self.under_way = true;
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

    /// Splits entries into a list for each shard, by the slot that `slot_of` reads from an entry.
    fn split<T>(&self, entries: Vec<T>, slot_of: impl Fn(&T) -> usize) -> Vec<Vec<T>> {
        let mut lists: Vec<Vec<T>> = self.job.shards.iter().map(|_| Vec::new()).collect();
        for entry in entries {
            lists[slot_of(&entry) / self.shard_size].push(entry);
        }
        lists
    }

    /// Gives each shard a command, made from its first slot and its list.
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
            return; // freed here, so that there is room at once
        }
        // The last owner of the job frees the environments. It must be neither this thread nor a worker.
        let mut deferred = Some((Arc::clone(&self.job), self.runner.take(), self.drop_hook.take(), self.freed.take()));
        self.workers.reaper.drop_later(Box::new(move || {
            let is_alone = deferred.as_ref().is_none_or(|(job, ..)| Arc::strong_count(job) == 1);
            if let Some((job, runner, drop_hook, freed)) = deferred.take_if(|_| is_alone) {
                if let Some(hook) = drop_hook {
                    hook(draws(&job));
                }
                drop((job, runner));
                drop(freed); // after the environments
            }
            is_alone
        }));
    }
}

/// Returns the draws of all environments of a job, in order of slots.
fn draws(job: &Job) -> Vec<Draw> {
    job.shards.iter().flat_map(|shard| lock(shard).draws().collect::<Vec<_>>()).collect()
}

/// Makes the job of a batch of `size` environments.
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

/// Cuts groups into parts of `size` slots, the last of which may have fewer.
fn cut(groups: &[SlotGroup], size: usize) -> Vec<Vec<SlotGroup>> {
    let (mut parts, mut part, mut free_slots) = (Vec::new(), Vec::new(), size);
    for group in groups {
        let mut deferred = group.clone();
        while deferred.size > 0 {
            let taken = deferred.size.min(free_slots);
            part.push(SlotGroup { size: taken, ..deferred.clone() });
            deferred.size -= taken;
            // Once nothing is left of the group, this index is never used and may overflow.
            deferred.episodes.environment_index = deferred.episodes.environment_index.wrapping_add(taken as u32);
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

/// The number of environments in a shard: by cost, but small enough that every worker has a shard, if a shard is worth
/// a wake-up.
fn shard_size(spec: &EnvironmentSpec, batch: usize, workers: usize) -> usize {
    let by_workers = batch.div_ceil(workers);
    let share = spec.step_cost * by_workers as f64;
    let cost = (share / SHARDS_PER_WORKER).clamp(*SHARD_COST_US.start(), *SHARD_COST_US.end());
    let by_cost = (cost / spec.step_cost).ceil() as usize;
    if share >= MIN_WORKER_SHARE_US { by_cost.min(by_workers).max(1) } else { by_cost.max(1) }
}
