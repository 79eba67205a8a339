//! A policy that chooses the actions of a batch on the server.

use crate::{
    env::FinishedEpisode,
    pool::{
        Error,
        shard::{Shard, set_actions},
        sync::lock,
    },
};
use perturb_policy::{
    CollectUntil, Inputs, Normalisers, Player, PlayerRole, PlayerTrainingState, PolicySpec, RemainingRollout, SlotEnd,
    StepOutcome,
};
use rand_chacha::ChaCha8Rng;
use std::sync::Mutex;

/// A policy as a client sent it, before its first step. The session has checked that the fields fit each other and the
/// batch.
#[derive(Debug, Clone)]
pub struct ReceivedPolicy {
    /// The layer sizes of the networks.
    pub spec: PolicySpec,
    /// The builder of the networks' inputs, in its initial state.
    pub inputs: Inputs,
    /// The normalisers of observations and rewards, with their running statistics.
    pub normalisers: Normalisers,
    /// Whether the policy is trained or tested, with the random stream of its actions.
    pub role: PolicyRole,
    /// The saved state from which a training continues. If `None`, the policy starts with an empty memory in every
    /// environment, as at the start of a trial.
    pub state: Option<PlayerTrainingState>,
    /// All weights of the networks, `[P]`, finite.
    pub weights: Vec<f32>,
    /// The number of episodes in a trial.
    pub episodes_per_trial: u32,
}

/// Whether a policy is trained or tested. It determines the random streams of the actions, and whether the normalisers'
/// running statistics are updated.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant)] // there is only one for each policy
pub enum PolicyRole {
    /// In training, all actions are drawn from this stream. The normalisers' statistics are updated.
    Training(ChaCha8Rng),
    /// In a test, each trial has its own stream, from which its actions are drawn. The normalisers' statistics are
    /// frozen.
    Testing {
        /// The seed, which together with the environment index and the trial index determines a trial's stream.
        seed: u64,
    },
}

/// A policy that plays a batch, with the state that it keeps between two steps.
pub struct PolicyRunner {
    player: Player,
    pub(in crate::pool) task: RemainingRollout,
    /// The seed of [`PolicyRole::Testing`]; `None` in training.
    seed: Option<u64>,
    /// The outputs of all shards in the last step.
    pub(in crate::pool) step: StepBuffers,
    spec: PolicySpec,
}

/// The outputs of one step of all environments. The buffers are reused for each step.
#[derive(Default)]
pub(in crate::pool) struct StepBuffers {
    observations: Vec<f32>,
    rewards: Vec<f32>,
    pub(in crate::pool) terminated: Vec<bool>,
    pub(in crate::pool) truncated: Vec<bool>,
    final_observations: Vec<f32>,
    ended: Vec<SlotEnd>,
    /// The episodes that ended in the step, each with its slot.
    pub(in crate::pool) ends: Vec<(u32, FinishedEpisode)>,
}

impl PolicyRunner {
    /// Starts a policy in the environments of `shards`, without resetting them. The policy continues from its saved
    /// state. Without a saved state, its memory is empty, as at the start of a trial.
    pub(in crate::pool) fn begin(policy: ReceivedPolicy, shards: &[Mutex<Shard>]) -> Result<Self, Error> {
        let ReceivedPolicy { spec, inputs, normalisers, role, state, weights, episodes_per_trial } = policy;
        let trials: Vec<(u32, u64)> =
            shards.iter().flat_map(|shard| lock(shard).trials().collect::<Vec<_>>()).collect();
        let n_envs = trials.len();
        let (role, seed) = match role {
            PolicyRole::Training(stream) => (PlayerRole::Training(stream), None),
            PolicyRole::Testing { seed } => (PlayerRole::testing_in(seed, trials.into_iter()), Some(seed)),
        };
        let player = Player::new(&spec, inputs, n_envs, episodes_per_trial, normalisers, role);
        let mut runner = Self { player, task: RemainingRollout::Steps(0), seed, step: StepBuffers::default(), spec };
        runner.player.load(&weights)?;
        match state {
            Some(state) => runner.player.restore(&state)?,
            None => {
                runner.step.gather_observations(shards);
                runner.player.begin(&runner.step.observations, None)?;
            }
        }
        Ok(runner)
    }

    /// The layer sizes of the policy's networks.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// The player, which holds the networks, normalisers and random streams.
    pub fn player(&self) -> &Player {
        &self.player
    }

    /// The part of the current task that is still to be played.
    pub fn task(&self) -> &RemainingRollout {
        &self.task
    }

    /// Replaces the weights of the networks by `weights`, `[P]`.
    pub(in crate::pool) fn load(&mut self, weights: &[f32]) -> Result<(), Error> {
        Ok(self.player.load(weights)?)
    }

    /// Starts a task. Returns whether all environments must be reset first.
    pub(in crate::pool) fn begin_task(&mut self, task: CollectUntil) -> bool {
        self.task = task.begin(self.player.n_envs());
        matches!(task, CollectUntil::Episodes(_))
    }

    /// Starts the episodes of a task. Call this method after all environments were reset.
    pub(in crate::pool) fn begin_episodes(&mut self, shards: &[Mutex<Shard>]) -> Result<(), Error> {
        let Self { player, task, seed, step, .. } = self;
        step.gather_observations(shards);
        player.begin(&step.observations, Some(task))?;
        if let Some(seed) = *seed {
            for shard in shards {
                let shard = lock(shard);
                let slots = shard.first_slot..;
                slots.zip(shard.trials()).for_each(|(slot, (_, trial))| player.begin_trial(slot, seed, trial));
            }
        }
        Ok(())
    }

    /// Chooses the next actions and gives them to the shards. Returns the actions, encoded as in messages.
    pub(in crate::pool) fn act(&mut self, shards: &[Mutex<Shard>]) -> Result<&[u8], Error> {
        let actions = self.player.act()?;
        set_actions(shards, actions);
        Ok(actions)
    }

    /// Gathers the outputs of a step from the shards, and records them in the player and the task.
    pub(in crate::pool) fn observe(&mut self, shards: &[Mutex<Shard>]) -> Result<(), Error> {
        let Self { player, task, step, .. } = self;
        step.gather(shards);
        task.advance(step.ended.iter().map(|end| end.slot));
        Ok(player.observe(&step.outcome(), Some(task))?)
    }

    /// The values V of the current observations, `[N]`.
    pub(in crate::pool) fn last_values(&mut self) -> Result<&[f32], Error> {
        Ok(self.player.last_values(&self.task)?)
    }
}

impl StepBuffers {
    fn gather_observations(&mut self, shards: &[Mutex<Shard>]) {
        self.observations.clear();
        shards.iter().for_each(|shard| self.observations.extend_from_slice(&lock(shard).observations));
    }

    fn gather(&mut self, shards: &[Mutex<Shard>]) {
        self.observations.clear();
        self.rewards.clear();
        self.terminated.clear();
        self.truncated.clear();
        self.final_observations.clear();
        self.ended.clear();
        self.ends.clear();
        for shard in shards {
            let shard = &mut *lock(shard);
            self.observations.extend_from_slice(&shard.observations);
            self.rewards.extend_from_slice(&shard.rewards);
            self.terminated.extend(shard.terminated.iter().map(|&flag| flag == 1));
            self.truncated.extend(shard.truncated.iter().map(|&flag| flag == 1));
            self.final_observations.extend_from_slice(&shard.final_observations);
            self.ends.append(&mut shard.ended);
        }
        self.ended.extend(self.ends.iter().map(|(slot, end)| SlotEnd {
            slot: *slot as usize,
            trial_index: end.id.trial_index,
            episode_in_trial: end.id.episode_in_trial,
        }));
    }

    fn outcome(&self) -> StepOutcome<'_> {
        let Self { observations, rewards, terminated, truncated, final_observations, ended, .. } = self;
        StepOutcome { observations, rewards, terminated, truncated, final_observations, ended }
    }
}
