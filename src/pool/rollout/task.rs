//! A rollout: the steps of one reply to `act`, which a policy plays without involving the session.
//!
//! The worker that runs a step's last shard gathers the outcome, chooses the next actions and gives them to the shards.
//! Then the job goes to the queue's tail, like that of any other step. The session is woken at the rollout's end.

use super::policy_runner::{Policy, PolicyRunner};
use crate::{
    env::EpisodeEnd,
    pool::{
        Error,
        encode::{push_f32, push_flags},
        shard::{Command, Shard},
        sync::lock,
    },
};
use bytes::BytesMut;
use perturb_policy::{CollectUntil, RemainingRollout, RolloutStep};
use std::sync::Mutex;

/// A reply ends at about this length: many gRPC libraries receive no more than 4 MiB.
const MAX_REPLY_BYTES: usize = 4_000_000;
/// The estimated length of an episode's end without its receipt.
const EPISODE_END_BYTES: usize = 100;
/// The initial capacity of buffers, in steps, if the number of steps is not known.
const INITIAL_CAPACITY_STEPS: usize = 256;

/// The parameters of one rollout.
#[derive(Debug, Clone)]
pub struct RolloutRequest {
    /// The policy to play; if `None`, the previous one continues.
    pub policy: Option<Policy>,
    /// New weights of the previous policy, `[P]`, finite; if `None`, it keeps its own.
    pub weights: Option<Vec<f32>>,
    /// A new task; if `None`, the previous one continues.
    pub task: Option<CollectUntil>,
    /// The maximum number of steps, at least 1.
    pub max_steps: usize,
    /// Whether only the episodes that ended are recorded.
    pub only_ended: bool,
}

/// A rollout of T steps of N environments. Arrays are little-endian, row-major `[T, N, …]`, as on the wire.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rollout {
    /// T.
    pub steps: usize,
    /// f32 `[T, N, I]`
    pub observations: BytesMut,
    /// u8 `[T, N]`
    pub starts: BytesMut,
    /// i32 `[T, N]` or f32 `[T, N, A]`
    pub actions: BytesMut,
    /// f32 `[T, N]`
    pub log_probs: BytesMut,
    /// f32 `[T, N]`
    pub values: BytesMut,
    /// f32 `[T, N]`
    pub rewards: BytesMut,
    /// u8 `[T, N]`
    pub terminated: BytesMut,
    /// u8 `[T, N]`
    pub truncated: BytesMut,
    /// f32 `[T, N]`
    pub truncation_values: BytesMut,
    /// The episodes that ended and count for the task, in order of steps and slots.
    pub ended: Vec<EndedAt>,
    /// Whether the task is done.
    pub finished: bool,
    /// f32 `[N]`: V of the present observations, when finished.
    pub last_values: BytesMut,
    /// f32 `[N, S]`: the memory of the policy at the task's beginning, if it began in this rollout.
    pub memory: BytesMut,
    /// The estimated length of `ended`.
    ended_bytes: usize,
}

/// An episode that ended.
#[derive(Debug, Clone, PartialEq)]
pub struct EndedAt {
    /// The step of the rollout.
    pub step: usize,
    /// The slot.
    pub slot: u32,
    /// The episode that ended.
    pub end: EpisodeEnd,
    /// Whether the task ended it.
    pub terminated: bool,
    /// Whether the step limit ended it.
    pub truncated: bool,
}

/// The event that a rollout waits for.
enum RolloutPhase {
    /// The rollout has not begun: it waits for a worker.
    Begin,
    /// All environments are being reset.
    Reset,
    /// All environments are taking a step.
    Step,
}

/// The state of a rollout.
pub(in crate::pool) struct RolloutTask {
    request: RolloutRequest,
    runner: Option<Box<PolicyRunner>>,
    phase: RolloutPhase,
    rollout: Rollout,
    error: Option<Error>,
}

impl RolloutTask {
    /// Makes a rollout. `runner` is the previous policy, which plays if the request has no new one.
    pub(in crate::pool) fn new(request: RolloutRequest, runner: Option<Box<PolicyRunner>>) -> Self {
        Self { request, runner, phase: RolloutPhase::Begin, rollout: Rollout::default(), error: None }
    }

    /// Returns the policy and the rollout, or the error with which the rollout failed.
    pub(in crate::pool) fn finish(self) -> Result<(Option<Box<PolicyRunner>>, Rollout), Error> {
        self.error.map_or(Ok((self.runner, self.rollout)), Err)
    }

    /// Records the outcome of the shards' last command and gives them the next one. Returns false at the rollout's end,
    /// which comes at once if it is `halted`.
    pub(in crate::pool) fn after_step(&mut self, shards: &[Mutex<Shard>], halted: bool) -> bool {
        match self.advance(shards) {
            Ok(goes_on) => goes_on && !halted,
            Err(error) => {
                self.error = Some(error);
                false
            }
        }
    }

    fn advance(&mut self, shards: &[Mutex<Shard>]) -> Result<bool, Error> {
        let Self { request, runner, phase, rollout, .. } = self;
        if let Some(policy) = request.policy.take() {
            *runner = Some(Box::new(PolicyRunner::begin(policy, shards)?));
        }
        let runner = runner.as_mut().ok_or(Error::Defect)?;
        match phase {
            RolloutPhase::Begin => {
                if let Some(weights) = request.weights.take() {
                    runner.load(&weights)?;
                }
                let begins = request.task.is_some();
                if request.task.take().is_some_and(|task| runner.begin_task(task)) {
                    shards.iter().for_each(|shard| lock(shard).command = Command::ResetAll);
                    *phase = RolloutPhase::Reset;
                    return Ok(true);
                }
                rollout.begin(runner, begins, request);
            }
            RolloutPhase::Reset => {
                runner.begin_episodes(shards)?;
                rollout.begin(runner, true, request);
            }
            RolloutPhase::Step => {
                runner.observe(shards)?;
                rollout.take(runner, request.only_ended);
                if runner.task().is_done() {
                    rollout.finished = true;
                    if !request.only_ended {
                        push_f32(&mut rollout.last_values, runner.last_values()?);
                    }
                    return Ok(false);
                }
                if rollout.steps >= request.max_steps || rollout.size() >= MAX_REPLY_BYTES {
                    return Ok(false);
                }
            }
        }
        *phase = RolloutPhase::Step;
        let actions = runner.act(shards)?;
        if !request.only_ended {
            rollout.actions.extend_from_slice(actions);
        }
        Ok(true)
    }
}

impl Rollout {
    /// Allocates the arrays, and records the policy's memory if a task `begins`.
    fn begin(&mut self, runner: &PolicyRunner, begins: bool, request: &RolloutRequest) {
        if request.only_ended {
            return;
        }
        if begins {
            push_f32(&mut self.memory, runner.player().memory());
        }
        let (n_envs, spec) = (runner.player().n_envs(), runner.spec());
        let step_bytes = n_envs * (4 * (spec.observation_size + spec.action.width() + 4) + 3);
        let steps = match runner.task() {
            RemainingRollout::Steps(left) => request.max_steps.min(*left),
            RemainingRollout::Episodes(_) => request.max_steps.min(INITIAL_CAPACITY_STEPS),
        };
        let steps = steps.min(MAX_REPLY_BYTES / step_bytes + 1);
        let with_capacity = |bytes: usize| BytesMut::with_capacity(steps * n_envs * bytes);
        self.observations = with_capacity(4 * spec.observation_size);
        self.actions = with_capacity(4 * spec.action.width());
        for array in [&mut self.log_probs, &mut self.values, &mut self.rewards, &mut self.truncation_values] {
            *array = with_capacity(4);
        }
        for array in [&mut self.starts, &mut self.terminated, &mut self.truncated] {
            *array = with_capacity(1);
        }
    }

    /// Appends the outputs of a step.
    fn take(&mut self, runner: &mut PolicyRunner, only_ended: bool) {
        if !only_ended {
            self.push(runner.player().played());
        }
        let PolicyRunner { task, step, .. } = runner;
        for (slot, end) in step.ends.drain(..).filter(|(slot, _)| task.counts(*slot as usize)) {
            self.ended_bytes += end_bytes(&end);
            let (terminated, truncated) = (step.terminated[slot as usize], step.truncated[slot as usize]);
            self.ended.push(EndedAt { step: self.steps, slot, end, terminated, truncated });
        }
        self.steps += 1;
    }

    fn push(&mut self, step: RolloutStep<'_>) {
        push_f32(&mut self.observations, step.observations);
        push_flags(&mut self.starts, step.starts);
        push_f32(&mut self.log_probs, step.log_probs);
        push_f32(&mut self.values, step.values);
        push_f32(&mut self.rewards, step.rewards);
        push_flags(&mut self.terminated, step.terminated);
        push_flags(&mut self.truncated, step.truncated);
        push_f32(&mut self.truncation_values, step.truncation_values);
    }

    /// The estimated length after one more step, bytes.
    fn size(&self) -> usize {
        let arrays = [&self.observations, &self.actions, &self.log_probs, &self.values, &self.rewards];
        let others = [&self.truncation_values, &self.starts, &self.terminated, &self.truncated];
        let bytes: usize = arrays.into_iter().chain(others).map(|array| array.len()).sum();
        bytes + bytes / self.steps.max(1) + self.ended_bytes + self.memory.len()
    }
}

/// The estimated length of an episode's end on the wire.
fn end_bytes(end: &EpisodeEnd) -> usize {
    let receipt = end.receipt.as_ref();
    EPISODE_END_BYTES + receipt.map_or(0, |r| 8 * (r.requested.len() + r.applied.len()) + r.model_hash.len())
}
