//! A rollout: the steps of one reply, which a policy plays without a session in between.
//!
//! The worker that ends a step's last shard has the rollout take the outcome, choose the next actions and give them to the
//! shards. Then the job goes to the queue's tail, like that of any other step. The session is woken at the rollout's end.

use super::play::{Policy, PolicyRunner};
use crate::{
    env::EpisodeEnd,
    pool::{
        Error,
        encode::{put, put_flags},
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
/// The steps that buffers are made for at first where the number of steps is not known.
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
    pub most_steps: usize,
    /// Records nothing but the episodes that ended.
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
    /// The episodes that ended and count, in order of steps and slots.
    pub ended: Vec<EndedAt>,
    /// Whether nothing is left of the task.
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
enum Phase {
    /// The first worker that takes it.
    Begin,
    /// All environments to be reset.
    Reset,
    /// A step.
    Step,
}

/// The state of a rollout.
pub(in crate::pool) struct RolloutTask {
    turn: RolloutRequest,
    play: Option<Box<PolicyRunner>>,
    phase: Phase,
    played: Rollout,
    error: Option<Error>,
}

impl RolloutTask {
    /// A rollout of the previous policy, if the request has no new one.
    pub(in crate::pool) fn new(turn: RolloutRequest, play: Option<Box<PolicyRunner>>) -> Self {
        Self { turn, play, phase: Phase::Begin, played: Rollout::default(), error: None }
    }

    /// Returns the rollout, with the policy unless it failed.
    pub(in crate::pool) fn finish(self) -> Result<(Option<Box<PolicyRunner>>, Rollout), Error> {
        self.error.map_or(Ok((self.play, self.played)), Err)
    }

    /// Takes what the shards did last and tells them what to do next. Returns false at the rollout's end, which comes in any
    /// case when it is `halted`.
    pub(in crate::pool) fn conduct(&mut self, shards: &[Mutex<Shard>], halted: bool) -> bool {
        match self.advance(shards) {
            Ok(goes_on) => goes_on && !halted,
            Err(error) => {
                self.error = Some(error);
                false
            }
        }
    }

    fn advance(&mut self, shards: &[Mutex<Shard>]) -> Result<bool, Error> {
        let Self { turn, play, phase, played, .. } = self;
        if let Some(policy) = turn.policy.take() {
            *play = Some(Box::new(PolicyRunner::begin(policy, shards)?));
        }
        let play = play.as_mut().ok_or(Error::Defect)?;
        match phase {
            Phase::Begin => {
                if let Some(weights) = turn.weights.take() {
                    play.load(&weights)?;
                }
                let begins = turn.task.is_some();
                if turn.task.take().is_some_and(|task| play.begin_task(task)) {
                    shards.iter().for_each(|shard| lock(shard).command = Command::ResetAll);
                    *phase = Phase::Reset;
                    return Ok(true);
                }
                played.begin(play, begins, turn);
            }
            Phase::Reset => {
                play.begin_episodes(shards)?;
                played.begin(play, true, turn);
            }
            Phase::Step => {
                play.observe(shards)?;
                played.take(play, turn.only_ended);
                if play.task().is_done() {
                    played.finished = true;
                    if !turn.only_ended {
                        put(&mut played.last_values, play.last_values()?);
                    }
                    return Ok(false);
                }
                if played.steps >= turn.most_steps || played.size() >= MAX_REPLY_BYTES {
                    return Ok(false);
                }
            }
        }
        *phase = Phase::Step;
        let actions = play.act(shards)?;
        if !turn.only_ended {
            played.actions.extend_from_slice(actions);
        }
        Ok(true)
    }
}

impl Rollout {
    /// Allocates the arrays, and records the memory of the policy where a task `begins`.
    fn begin(&mut self, play: &PolicyRunner, begins: bool, turn: &RolloutRequest) {
        if turn.only_ended {
            return;
        }
        if begins {
            put(&mut self.memory, play.player().memory());
        }
        let (n_envs, spec) = (play.player().n_envs(), play.spec());
        let step_bytes = n_envs * (4 * (spec.observation_size + spec.action.width() + 4) + 3);
        let steps = match play.task() {
            RemainingRollout::Steps(left) => turn.most_steps.min(*left),
            RemainingRollout::Episodes(_) => turn.most_steps.min(INITIAL_CAPACITY_STEPS),
        };
        let steps = steps.min(MAX_REPLY_BYTES / step_bytes + 1);
        let room = |bytes: usize| BytesMut::with_capacity(steps * n_envs * bytes);
        self.observations = room(4 * spec.observation_size);
        self.actions = room(4 * spec.action.width());
        for array in [&mut self.log_probs, &mut self.values, &mut self.rewards, &mut self.truncation_values] {
            *array = room(4);
        }
        for array in [&mut self.starts, &mut self.terminated, &mut self.truncated] {
            *array = room(1);
        }
    }

    /// Appends the outputs of a step.
    fn take(&mut self, play: &mut PolicyRunner, only_ended: bool) {
        if !only_ended {
            self.push(play.player().played());
        }
        let PolicyRunner { task, step, .. } = play;
        for (slot, end) in step.ends.drain(..).filter(|(slot, _)| task.counts(*slot as usize)) {
            self.ended_bytes += end_bytes(&end);
            let (terminated, truncated) = (step.terminated[slot as usize], step.truncated[slot as usize]);
            self.ended.push(EndedAt { step: self.steps, slot, end, terminated, truncated });
        }
        self.steps += 1;
    }

    fn push(&mut self, step: RolloutStep<'_>) {
        put(&mut self.observations, step.observations);
        put_flags(&mut self.starts, step.starts);
        put(&mut self.log_probs, step.log_probs);
        put(&mut self.values, step.values);
        put(&mut self.rewards, step.rewards);
        put_flags(&mut self.terminated, step.terminated);
        put_flags(&mut self.truncated, step.truncated);
        put(&mut self.truncation_values, step.truncation_values);
    }

    /// The estimated length in bytes, with another step.
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
