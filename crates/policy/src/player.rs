//! A policy that plays in N environments, between whoever steps them and whoever learns.

use rand_chacha::ChaCha8Rng;

use crate::act::{Actor, Acts, Streams};
use crate::collect_until::Remaining;
use crate::error::{Result, check_length};
use crate::gradient::GradientBackend;
use crate::inputs::Inputs;
use crate::normalisers::{Normalisers, Statistics};
use crate::random::{Purpose, normal, stream, trial_stream};
use crate::spec::PolicySpec;

/// Plays N environments with a policy: [`Player::act`] chooses actions, somebody steps the environments, and
/// [`Player::observe`] takes what came of it. Learner and server play with the same code, so that they give the same
/// bytes.
///
/// Memories are emptied where a trial ends. In a trial of one episode that is the episode's end. In a trial of several
/// (RL²) the policy's inputs tell it of the ends in between, and to whoever learns the trial is one episode: flags of
/// ends in between are left out, and the discounted returns that rewards are divided by run on.
///
/// Final observations are normalised with the statistics that have taken in the observations after them. Noise is on what
/// actions are chosen on alone: neither on final observations nor in statistics.
#[derive(Clone, Debug)]
pub struct Player {
    actor: Actor,
    inputs: Inputs,
    role: Role,
    normalisers: Normalisers,
    observation_size: usize,
    episodes_per_trial: u32,
    /// Standard deviation of what is added to observations in training, after normalisation.
    noise: f64,
    /// `[N, O]` normalised observations that the next actions are chosen on.
    observations: Vec<f32>,
    /// `[N]` whether those are the first of a trial.
    starts: Vec<bool>,
    /// What was played last.
    last: Last,
    /// Actions as the protocol wants them.
    bytes: Vec<u8>,
    /// V of the present observations.
    values: Vec<f32>,
}

/// Where actions come from, and whether statistics run.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // a player has one, and its stream is read at every action
pub enum Role {
    /// Statistics run, and one stream gives all noise and all actions, in the environments' order.
    Training(ChaCha8Rng),
    /// Statistics are frozen, and each trial has a stream of its own, see [`trial_stream`].
    Testing(TrialStreams),
}

/// The streams of the present trials.
#[derive(Clone, Debug)]
pub struct TrialStreams {
    seed: u64,
    /// `[N]` the environments' indices.
    indices: Vec<u32>,
    streams: Vec<ChaCha8Rng>,
}

/// What stands beside a policy's weights and decides what it does next; all of a training's player but its normalisers.
#[derive(Clone, Debug, PartialEq)]
pub struct PlayerState {
    /// `[N, O]` normalised observations that the next actions are chosen on.
    pub observations: Vec<f32>,
    /// `[N]` whether those are the first of a trial.
    pub starts: Vec<bool>,
    /// `[N, E]` what stands beside the observations, see [`Inputs`].
    pub outcomes: Vec<f32>,
    /// `[N, S]` what the policy remembers; empty for a feed-forward policy.
    pub memory: Vec<f32>,
    /// The stream of sampled actions and of noise.
    pub actions: ChaCha8Rng,
}

/// An episode that ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ended {
    /// In which of the N environments.
    pub slot: usize,
    /// Counts the environment's trials from 0.
    pub trial_index: u64,
    /// Counts the trial's episodes from 0.
    pub episode_in_trial: u32,
}

/// What came of a step in N environments that are reset by themselves where an episode ends.
#[derive(Clone, Copy, Debug)]
pub struct Outcome<'a> {
    /// `[N, O]` observations; where an episode ended, the first one of the next.
    pub observations: &'a [f32],
    /// `[N]` rewards.
    pub rewards: &'a [f32],
    /// `[N]` whether the task ended the episode.
    pub terminated: &'a [bool],
    /// `[N]` whether the step limit ended it.
    pub truncated: &'a [bool],
    /// `[K, O]` last observations of the episodes that ended, in the order of `ended`.
    pub final_observations: &'a [f32],
    /// `[K]` the episodes that ended, in order of slots.
    pub ended: &'a [Ended],
}

/// A step of N environments, as a rollout wants it; or T steps of them, where every array is `[T, N, …]`.
#[derive(Clone, Copy, Debug)]
pub struct RolloutStep<'a> {
    /// `[N, I]` inputs that the actions were chosen on, normalised.
    pub observations: &'a [f32],
    /// `[N]` whether they are the first that the policy remembers: its memory was emptied before them.
    pub starts: &'a [bool],
    /// `[N, A]` actions, as in [`Acts`].
    pub actions: &'a [f32],
    /// `[N]` log-probabilities of the actions under the acting policy.
    pub log_probs: &'a [f32],
    /// `[N]` V(s_t).
    pub values: &'a [f32],
    /// `[N]` rewards r_t that the actions brought, normalised.
    pub rewards: &'a [f32],
    /// `[N]` whether the task ended the episode, or the trial.
    pub terminated: &'a [bool],
    /// `[N]` whether the time limit ended it.
    pub truncated: &'a [bool],
    /// `[N]` V(final observation) where truncated; ignored elsewhere.
    pub truncation_values: &'a [f32],
}

/// The arrays of a [`RolloutStep`], and what they are made of.
#[derive(Clone, Debug)]
struct Last {
    acted_on: Vec<f32>,
    starts: Vec<bool>,
    acts: Acts,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    truncation_values: Vec<f32>,
    /// `[N]` whether an episode ended, …
    done: Vec<bool>,
    /// … and a trial with it.
    trial_ended: Vec<bool>,
    finals: Vec<f32>,
    truncated_slots: Vec<usize>,
}

impl Streams for Role {
    fn of(&mut self, environment: usize) -> &mut ChaCha8Rng {
        match self {
            Self::Training(stream) => stream,
            Self::Testing(trials) => &mut trials.streams[environment],
        }
    }
}

impl Role {
    /// That of a training with `seed`.
    pub fn training(seed: u64) -> Self {
        Self::Training(stream(seed, Purpose::Actions))
    }

    /// That of a test with `seed` in N = `n_envs` environments with successive indices, at the start of their first
    /// trials.
    pub fn testing(seed: u64, first_environment_index: u32, n_envs: usize) -> Self {
        Self::testing_in(seed, (0..n_envs).map(|slot| (first_environment_index + slot as u32, 0)))
    }

    /// That of a test with `seed` in environments with these indices, in these of their trials.
    pub fn testing_in(seed: u64, environments: impl Iterator<Item = (u32, u64)>) -> Self {
        let stream = |(index, trial)| (index, trial_stream(seed, Purpose::TestActions, index, trial));
        let (indices, streams) = environments.map(stream).unzip();
        Self::Testing(TrialStreams { seed, indices, streams })
    }

    fn statistics(&self) -> Statistics {
        if let Self::Training(_) = self { Statistics::Running } else { Statistics::Frozen }
    }
}

impl TrialStreams {
    /// That of the test.
    pub fn seed(&self) -> u64 {
        self.seed
    }
}

impl Player {
    /// A player whose weights are 0 until [`Player::load`], and whose environments are unknown until
    /// [`Player::begin`] or [`Player::restore`]. `inputs` are those of a policy of `spec`, fresh.
    pub fn new(
        spec: &PolicySpec,
        inputs: Inputs,
        n_envs: usize,
        episodes_per_trial: u32,
        normalisers: Normalisers,
        role: Role,
    ) -> Self {
        let observation_size = inputs.observation_size();
        Self {
            actor: Actor::new(spec, n_envs),
            inputs,
            role,
            normalisers,
            observation_size,
            episodes_per_trial,
            noise: 0.0,
            observations: vec![0.0; n_envs * observation_size],
            starts: vec![true; n_envs],
            last: Last::new(spec, n_envs),
            bytes: vec![0; 4 * n_envs * spec.action.width()],
            values: Vec::new(),
        }
    }

    /// The same, see [`Actor::act_uniformly`].
    #[must_use]
    pub fn uniformly(mut self) -> Self {
        self.actor.act_uniformly();
        self
    }

    /// The same, seeing observations, normalised if there is a normaliser, with normal noise of this standard deviation, at
    /// least 0, in training. What stands beside them has none.
    #[must_use]
    pub fn with_noise(self, noise: f64) -> Self {
        Self { noise, ..self }
    }

    /// The same, see [`Actor::keep_activations`].
    #[must_use]
    pub fn keeping_activations(mut self, n_steps: usize) -> Self {
        self.actor.keep_activations(n_steps);
        self
    }

    /// N.
    pub fn n_envs(&self) -> usize {
        self.starts.len()
    }

    /// Episodes in a trial.
    pub fn episodes_per_trial(&self) -> u32 {
        self.episodes_per_trial
    }

    /// O.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Takes over all weights `[P]` in a row; what is remembered stays.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length).
    pub fn load(&mut self, weights: &[f32]) -> Result<()> {
        self.actor.load_flat(weights)
    }

    /// Lets `backend` take the networks with which this player acts, see [`GradientBackend::reuse_activations`]. Weights must
    /// be loaded before this player acts again.
    pub fn give_activations(&mut self, backend: &mut dyn GradientBackend) {
        backend.reuse_activations(&mut self.actor);
    }

    /// A trial begins in every environment with `observations` `[N, O]`; running statistics take in those of the
    /// environments where `remaining` counts.
    ///
    /// # Errors
    /// Another length; numbers that are not finite.
    pub fn begin(&mut self, observations: &[f32], remaining: Option<&Remaining>) -> Result<()> {
        check_length("observations [N, O]", observations.len(), self.observations.len())?;
        self.observations.copy_from_slice(observations);
        let active = remaining.and_then(Remaining::active);
        self.normalisers.take_observations(&mut self.observations, self.role.statistics(), active)?;
        if let (Statistics::Running, Some(normaliser)) = (self.role.statistics(), &mut self.normalisers.rewards) {
            normaliser.reset_returns();
        }
        self.starts.fill(true);
        for slot in 0..self.starts.len() {
            self.actor.forget(slot);
            self.inputs.forget(slot);
        }
        self.add_noise();
        Ok(())
    }

    /// The environment of `slot` was brought to another state, where it is observed as `observation` `[O]`; statistics
    /// stay.
    ///
    /// # Errors
    /// Another length.
    pub fn see(&mut self, slot: usize, observation: &[f32]) -> Result<()> {
        check_length("observation [O]", observation.len(), self.observation_size)?;
        let row = &mut self.observations[slot * self.observation_size..][..self.observation_size];
        row.copy_from_slice(observation);
        self.normalisers.normalise(row)
    }

    /// In a test: trial `trial_index` of a test with `seed` begins in `slot`. Nothing before it is remembered, and its
    /// address alone says which actions are sampled.
    pub fn begin_trial(&mut self, slot: usize, seed: u64, trial_index: u64) {
        self.actor.forget(slot);
        self.inputs.forget(slot);
        if let Role::Testing(trials) = &mut self.role {
            trials.streams[slot] = trial_stream(seed, Purpose::TestActions, trials.indices[slot], trial_index);
        }
    }

    /// The next actions, as the protocol wants them.
    ///
    /// # Errors
    /// [`Error::PolicyOutput`](crate::Error::PolicyOutput).
    pub fn act(&mut self) -> Result<&[u8]> {
        let Self { actor, inputs, role, observations, starts, last, bytes, .. } = self;
        let rows = inputs.of(observations);
        actor.act(rows, role, &mut last.acts)?;
        last.acted_on.clear();
        last.acted_on.extend_from_slice(rows);
        last.starts.copy_from_slice(starts);
        last.acts.write_bytes(bytes);
        Ok(bytes)
    }

    /// The last actions, as the protocol wants them.
    pub fn actions(&self) -> &[u8] {
        &self.bytes
    }

    /// Takes what came of the last actions, after `remaining` was advanced: of which environments statistics take in rewards
    /// and next observations.
    ///
    /// # Errors
    /// Other lengths; numbers that are not finite.
    pub fn observe(&mut self, outcome: &Outcome<'_>, remaining: Option<&Remaining>) -> Result<()> {
        let n_envs = self.starts.len();
        check_length("observations [N, O]", outcome.observations.len(), self.observations.len())?;
        check_length("rewards [N]", outcome.rewards.len(), n_envs)?;
        check_length("terminated [N]", outcome.terminated.len(), n_envs)?;
        check_length("truncated [N]", outcome.truncated.len(), n_envs)?;
        let finals = outcome.ended.len() * self.observation_size;
        check_length("final_observations [K, O]", outcome.final_observations.len(), finals)?;
        self.last.take(outcome, self.episodes_per_trial);

        let Self { actor, inputs, role, normalisers, last, observations, .. } = self;
        let (statistics, stepped) = (role.statistics(), remaining.and_then(Remaining::stepped));
        observations.copy_from_slice(outcome.observations);
        normalisers.take_rewards(&mut last.rewards, &last.trial_ended, statistics, stepped)?;
        normalisers.take_observations(observations, statistics, remaining.and_then(Remaining::active))?;
        inputs.remember(&last.acts, &last.rewards, &last.done)?;
        if statistics == Statistics::Running && last.gather_truncated(outcome, self.observation_size) {
            normalisers.normalise(&mut last.finals)?;
            actor.values_in(
                inputs.of_finals(&last.finals, &last.truncated_slots),
                &last.truncated_slots,
                &mut self.values,
            )?;
            let values = last.truncated_slots.iter().zip(&self.values);
            values.for_each(|(&slot, value)| last.truncation_values[slot] = *value);
        }
        let seed = if let Role::Testing(trials) = &self.role { trials.seed } else { 0 };
        for end in outcome.ended {
            if self.last.trial_ended[end.slot] {
                self.begin_trial(end.slot, seed, end.trial_index + 1);
            }
        }
        self.starts.copy_from_slice(&self.last.trial_ended);
        self.add_noise();
        Ok(())
    }

    fn add_noise(&mut self) {
        if let (Role::Training(stream), true) = (&mut self.role, self.noise > 0.0) {
            self.observations.iter_mut().for_each(|x| *x += (self.noise * normal(stream)) as f32);
        }
    }

    /// What was played last: the actions of [`Player::act`] and what [`Player::observe`] took.
    pub fn played(&self) -> RolloutStep<'_> {
        let last = &self.last;
        RolloutStep {
            observations: &last.acted_on,
            starts: &last.starts,
            actions: &last.acts.actions,
            log_probs: &last.acts.log_probs,
            values: &last.acts.values,
            rewards: &last.rewards,
            terminated: &last.terminated,
            truncated: &last.truncated,
            truncation_values: &last.truncation_values,
        }
    }

    /// V `[N]` of the present observations, or 0 after complete episodes, which nothing follows.
    ///
    /// # Errors
    /// Observations that do not fit.
    pub fn last_values(&mut self, remaining: &Remaining) -> Result<&[f32]> {
        match remaining {
            Remaining::Steps(_) => self.actor.values(self.inputs.of(&self.observations), &mut self.values)?,
            Remaining::Episodes(_) => {
                self.values.clear();
                self.values.resize(self.starts.len(), 0.0);
            }
        }
        Ok(&self.values)
    }

    /// `[N, S]` what the policy remembers of every environment.
    pub fn memory(&self) -> &[f32] {
        self.actor.memory()
    }

    /// Where actions come from.
    pub fn role(&self) -> &Role {
        &self.role
    }

    /// The statistics so far.
    pub fn normalisers(&self) -> &Normalisers {
        &self.normalisers
    }

    /// The state between two steps; `None` of a test.
    pub fn state(&self) -> Option<PlayerState> {
        let Role::Training(actions) = &self.role else { return None };
        Some(PlayerState {
            observations: self.observations.clone(),
            starts: self.starts.clone(),
            outcomes: self.inputs.outcomes().to_vec(),
            memory: self.actor.memory().to_vec(),
            actions: actions.clone(),
        })
    }

    /// Goes on as a training from a saved state.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length) if an array does not fit.
    pub fn restore(&mut self, state: &PlayerState) -> Result<()> {
        let PlayerState { observations, starts, outcomes, memory, actions } = state;
        check_length("observations [N, O]", observations.len(), self.observations.len())?;
        check_length("starts [N]", starts.len(), self.starts.len())?;
        self.inputs.restore(outcomes)?;
        self.actor.set_memory(memory)?;
        self.observations.copy_from_slice(observations);
        self.starts.copy_from_slice(starts);
        self.role = Role::Training(actions.clone());
        Ok(())
    }
}

impl Last {
    fn new(spec: &PolicySpec, n_envs: usize) -> Self {
        Self {
            acted_on: Vec::with_capacity(n_envs * spec.observation_size),
            starts: vec![true; n_envs],
            acts: Acts::new(spec.action, n_envs),
            rewards: vec![0.0; n_envs],
            terminated: vec![false; n_envs],
            truncated: vec![false; n_envs],
            truncation_values: vec![0.0; n_envs],
            done: vec![false; n_envs],
            trial_ended: vec![false; n_envs],
            finals: Vec::new(),
            truncated_slots: Vec::new(),
        }
    }

    /// Takes over rewards and flags; the ends of episodes that are not the last of their trial are none.
    fn take(&mut self, outcome: &Outcome<'_>, episodes_per_trial: u32) {
        self.rewards.copy_from_slice(outcome.rewards);
        self.terminated.copy_from_slice(outcome.terminated);
        self.truncated.copy_from_slice(outcome.truncated);
        self.done.fill(false);
        self.trial_ended.fill(false);
        for end in outcome.ended {
            let last = end.episode_in_trial + 1 >= episodes_per_trial;
            self.done[end.slot] = true;
            self.trial_ended[end.slot] = last;
            if !last {
                (self.terminated[end.slot], self.truncated[end.slot]) = (false, false);
            }
        }
    }

    /// Gathers the final observations whose values are asked for; whether there are any.
    fn gather_truncated(&mut self, outcome: &Outcome<'_>, observation_size: usize) -> bool {
        self.truncation_values.fill(0.0);
        self.finals.clear();
        self.truncated_slots.clear();
        let finals = outcome.final_observations.chunks_exact(observation_size);
        for (end, observation) in outcome.ended.iter().zip(finals).filter(|(end, _)| self.truncated[end.slot]) {
            self.finals.extend_from_slice(observation);
            self.truncated_slots.push(end.slot);
        }
        !self.finals.is_empty()
    }
}
