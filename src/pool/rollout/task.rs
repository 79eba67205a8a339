//! Rollouts: a request `act` makes the workers step the environments with a policy's actions, without the session. The
//! reply contains the steps of one rollout.
//!
//! The worker that runs the last shard of a step gathers the outputs, chooses the next actions and gives them to the
//! shards. Then the job goes to the back of the queue, as after any other step. The session is woken at the end of the
//! rollout.

use super::policy_runner::{PolicyRunner, ReceivedPolicy};
use crate::{
    env::FinishedEpisode,
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

/// The approximate maximum length of a reply, bytes: many gRPC libraries receive no more than 4 MiB.
const MAX_REPLY_BYTES: usize = 4_000_000;
/// The estimated encoded length of an episode's end without its receipt, bytes.
const EPISODE_END_BYTES: usize = 100;
/// The initial capacity of buffers, in steps, if the number of steps is not known in advance.
const INITIAL_CAPACITY_STEPS: usize = 256;

/// A request for one rollout.
#[derive(Debug, Clone)]
pub struct RolloutRequest {
    /// The policy to play; if `None`, the previous policy continues.
    pub policy: Option<ReceivedPolicy>,
    /// New weights for the previous policy, `[P]`, finite; if `None`, the policy keeps its weights.
    pub weights: Option<Vec<f32>>,
    /// The task to start: the steps or episodes that the policy has to play. If `None`, the previous task continues.
    pub task: Option<CollectUntil>,
    /// The maximum number of steps in this rollout, at least 1.
    pub max_steps: usize,
    /// Whether the reply contains only the ended episodes, and no arrays of steps.
    pub only_ended: bool,
}

/// The result of a rollout: T steps of N environments, in arrays `[T, N, …]`, row-major and little-endian, as in
/// messages. With [`RolloutRequest::only_ended`] all arrays are empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rollout {
    /// T, the number of steps.
    pub steps: usize,
    /// The inputs of the policy, normalised, f32 `[T, N, I]`.
    pub observations: BytesMut,
    /// 1 where the input is the first of a trial, u8 `[T, N]`.
    pub starts: BytesMut,
    /// The sampled actions, i32 `[T, N]` or f32 `[T, N, A]`.
    pub actions: BytesMut,
    /// The log-probabilities or log-densities of the actions, f32 `[T, N]`.
    pub log_probs: BytesMut,
    /// The values V of the inputs, f32 `[T, N]`.
    pub values: BytesMut,
    /// The rewards, normalised, f32 `[T, N]`.
    pub rewards: BytesMut,
    /// 1 where the environment's task ended the last episode of a trial, u8 `[T, N]`.
    pub terminated: BytesMut,
    /// 1 where the step limit ended the last episode of a trial, u8 `[T, N]`.
    pub truncated: BytesMut,
    /// The value V of the last observation where `truncated` is 1, otherwise 0, f32 `[T, N]`. In a test always 0.
    pub truncation_values: BytesMut,
    /// The episodes that ended, ordered by step, then by slot. If the task is a number of episodes per environment,
    /// episodes beyond this number are left out.
    pub ended: Vec<RolloutEpisodeEnd>,
    /// Whether the policy's task was finished in this rollout.
    pub finished: bool,
    /// The values V of the observations after the last step, f32 `[N]`; empty unless the task is finished. After a task
    /// of complete episodes they are 0.
    pub last_values: BytesMut,
    /// The recurrent policy's memory before the first step of the task, f32 `[N, 2H]`; empty unless the task began in
    /// this rollout.
    pub memory: BytesMut,
    /// The estimated encoded length of `ended`, bytes.
    ended_bytes: usize,
}

/// An episode that ended during a rollout.
#[derive(Debug, Clone, PartialEq)]
pub struct RolloutEpisodeEnd {
    /// The number of the step in which the episode ended, counted from 0 at the start of the rollout.
    pub step: usize,
    /// The slot of the environment.
    pub slot: u32,
    /// The facts about the ended episode.
    pub end: FinishedEpisode,
    /// Whether the environment's task ended the episode.
    pub terminated: bool,
    /// Whether the step limit ended the episode.
    pub truncated: bool,
}

/// The next event that advances a rollout.
enum RolloutPhase {
    /// A worker starts the rollout.
    Begin,
    /// The reset of all environments ends.
    Reset,
    /// A step of all environments ends.
    Step,
}

/// The state of a rollout on the workers.
pub(in crate::pool) struct RolloutTask {
    request: RolloutRequest,
    runner: Option<Box<PolicyRunner>>,
    phase: RolloutPhase,
    rollout: Rollout,
    error: Option<Error>,
}

impl RolloutTask {
    /// Makes a rollout that has not started yet. `runner` is the previous policy, which continues unless the request
    /// has a new one.
    pub(in crate::pool) fn new(request: RolloutRequest, runner: Option<Box<PolicyRunner>>) -> Self {
        Self { request, runner, phase: RolloutPhase::Begin, rollout: Rollout::default(), error: None }
    }

    /// Returns the policy and the result of the rollout, or the error with which the rollout failed.
    pub(in crate::pool) fn finish(self) -> Result<(Option<Box<PolicyRunner>>, Rollout), Error> {
        self.error.map_or(Ok((self.runner, self.rollout)), Err)
    }

    /// Records the outputs of the shards' last command and gives the shards the next command. Call this method once to
    /// start the rollout, and then each time all shards have carried out a command. Returns false at the end of the
    /// rollout. If `halted`, the rollout ends now.
    pub(in crate::pool) fn after_step(&mut self, shards: &[Mutex<Shard>], halted: bool) -> bool {
        match self.advance(shards) {
            Ok(continues) => continues && !halted,
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
    /// Allocates the arrays. If `begins`, a new task begins in this rollout, and the policy's memory is also recorded.
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
            self.ended.push(RolloutEpisodeEnd { step: self.steps, slot, end, terminated, truncated });
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

    /// The estimated encoded length of the rollout after one more step, bytes.
    fn size(&self) -> usize {
        let arrays = [&self.observations, &self.actions, &self.log_probs, &self.values, &self.rewards];
        let others = [&self.truncation_values, &self.starts, &self.terminated, &self.truncated];
        let bytes: usize = arrays.into_iter().chain(others).map(|array| array.len()).sum();
        bytes + bytes / self.steps.max(1) + self.ended_bytes + self.memory.len()
    }
}

/// The estimated encoded length of an episode's end, bytes.
fn end_bytes(end: &FinishedEpisode) -> usize {
    let receipt = end.receipt.as_ref();
    EPISODE_END_BYTES + receipt.map_or(0, |r| 8 * (r.requested.len() + r.applied.len()) + r.model_hash.len())
}
