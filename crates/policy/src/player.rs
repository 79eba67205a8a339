//! A policy that plays in N environments.

use rand_chacha::ChaCha8Rng;

use crate::act::{Actor, ActorOutput, Streams};
use crate::collect_until::RemainingRollout;
use crate::error::{Result, check_length};
use crate::gradient::GradientBackend;
use crate::inputs::Inputs;
use crate::normalisers::{Normalisers, Statistics};
use crate::random::{Purpose, normal, stream, trial_stream};
use crate::spec::PolicySpec;

/// Plays N environments with a policy. [`Player::act`] chooses actions, the caller steps the environments with them,
/// and [`Player::observe`] takes the results. The learner and the server share this code, so that both produce the same
/// bytes.
///
/// The policy's memory of an environment is cleared when a trial ends. A trial of one episode ends with its episode. In
/// a trial of several episodes (RL²), the done flag among the policy's inputs marks the ends of episodes within the
/// trial. The learner treats such a trial as one episode: its rollout omits these flags, and the discounted returns for
/// normalising rewards are not reset there.
///
/// The observations after a step are added to the statistics before the final observations are normalised. Noise is
/// added only to the observations from which actions are chosen, not to final observations or to statistics.
#[derive(Clone, Debug)]
pub struct Player {
    actor: Actor,
    inputs: Inputs,
    role: PlayerRole,
    normalisers: Normalisers,
    observation_size: usize,
    episodes_per_trial: u32,
    /// Standard deviation of the noise that is added to normalised observations in training.
    noise: f64,
    /// `[N, O]` normalised observations from which the next actions are chosen.
    observations: Vec<f32>,
    /// `[N]` whether the environment's observation is the first of a trial.
    starts: Vec<bool>,
    /// The last step, with its actions and results.
    previous: PreviousStep,
    /// The last actions, in the encoding of the protocol.
    bytes: Vec<u8>,
    /// Buffer for the values V of observations.
    values: Vec<f32>,
}

/// The role of a player in a training or a test: its random numbers, and whether its statistics are updated.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)] // a player has only one role, and reads its stream at every action
pub enum PlayerRole {
    /// In training, the statistics are updated. One random stream gives all actions and all noise, in the order of the
    /// environments.
    Training(ChaCha8Rng),
    /// In testing, the statistics are frozen. Each trial has its own random stream, see [`trial_stream`].
    Testing(TrialStreams),
}

/// The random streams of the trials in progress.
#[derive(Clone, Debug)]
pub struct TrialStreams {
    seed: u64,
    /// `[N]` environment indices, which are part of a stream's seed.
    indices: Vec<u32>,
    streams: Vec<ChaCha8Rng>,
}

/// The state of a player between two steps of a training, without weights and normalisers. Together with the weights
/// and the normalisers, it determines all further actions.
#[derive(Clone, Debug, PartialEq)]
pub struct PlayerTrainingState {
    /// `[N, O]` normalised observations from which the next actions are chosen.
    pub observations: Vec<f32>,
    /// `[N]` whether the environment's observation is the first of a trial.
    pub starts: Vec<bool>,
    /// `[N, E]` previous step of every environment: action, reward and done flag. E = 0 without RL².
    pub previous_steps: Vec<f32>,
    /// `[N, S]` the policy's memory; empty for a feed-forward policy.
    pub memory: Vec<f32>,
    /// The random stream for actions and noise.
    pub actions: ChaCha8Rng,
}

/// An episode that ended in a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotEnd {
    /// The environment, 0 … N-1.
    pub slot: usize,
    /// Index of the trial in its environment, from 0.
    pub trial_index: u64,
    /// Index of the episode in its trial, from 0.
    pub episode_in_trial: u32,
}

/// The results of a step in N environments, each of which is reset automatically when its episode ends.
#[derive(Clone, Copy, Debug)]
pub struct StepOutcome<'a> {
    /// `[N, O]` observations after the step. If an episode ended, this is the first observation of the next episode.
    pub observations: &'a [f32],
    /// `[N]` rewards.
    pub rewards: &'a [f32],
    /// `[N]` whether the task ended the episode.
    pub terminated: &'a [bool],
    /// `[N]` whether the step limit ended the episode.
    pub truncated: &'a [bool],
    /// `[K, O]` final observations of the episodes that ended, in the order of `ended`.
    pub final_observations: &'a [f32],
    /// `[K]` the episodes that ended, in order of slots.
    pub ended: &'a [SlotEnd],
}

/// A step of N environments as stored in a rollout, or T steps with arrays `[T, N, …]`.
#[derive(Clone, Copy, Debug)]
pub struct RolloutStep<'a> {
    /// `[N, I]` normalised inputs from which the actions were chosen.
    pub observations: &'a [f32],
    /// `[N]` whether the policy's memory was cleared before the step.
    pub starts: &'a [bool],
    /// `[N, A]` actions, as in [`ActorOutput`].
    pub actions: &'a [f32],
    /// `[N]` log-probabilities of the actions under the acting policy.
    pub log_probs: &'a [f32],
    /// `[N]` values V(s_t) of the observations.
    pub values: &'a [f32],
    /// `[N]` normalised rewards r_t that followed the actions.
    pub rewards: &'a [f32],
    /// `[N]` whether the task ended the episode; with RL², only at the end of a trial.
    pub terminated: &'a [bool],
    /// `[N]` whether the step limit ended the episode; with RL², only at the end of a trial.
    pub truncated: &'a [bool],
    /// `[N]` value V of the final observation, if `truncated`. Ignore the other elements.
    pub truncation_values: &'a [f32],
}

/// The arrays of the last step, see [`RolloutStep`], and temporary buffers.
#[derive(Clone, Debug)]
struct PreviousStep {
    acted_on: Vec<f32>,
    starts: Vec<bool>,
    acts: ActorOutput,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    truncation_values: Vec<f32>,
    /// `[N]` whether an episode ended.
    done: Vec<bool>,
    /// `[N]` whether a trial ended.
    trial_ended: Vec<bool>,
    finals: Vec<f32>,
    truncated_slots: Vec<usize>,
}

impl Streams for PlayerRole {
    fn stream(&mut self, environment: usize) -> &mut ChaCha8Rng {
        match self {
            Self::Training(stream) => stream,
            Self::Testing(trials) => &mut trials.streams[environment],
        }
    }
}

impl PlayerRole {
    /// Returns the role for a training with `seed`.
    pub fn training(seed: u64) -> Self {
        Self::Training(stream(seed, Purpose::Actions))
    }

    /// Returns the role for a test with `seed` in N = `n_envs` environments. Their environment indices are successive
    /// numbers from `first_environment_index`, and each is at the start of its first trial.
    pub fn testing(seed: u64, first_environment_index: u32, n_envs: usize) -> Self {
        Self::testing_in(seed, (0..n_envs).map(|slot| (first_environment_index + slot as u32, 0)))
    }

    /// Returns the role for a test with `seed`. `environments` gives the environment index and the trial index of each.
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
    /// Returns the seed of the test.
    pub fn seed(&self) -> u64 {
        self.seed
    }
}

impl Player {
    /// Creates a player. `inputs` must be new and fit `spec`. Weights are 0 until [`Player::load`], and observations
    /// are 0 until [`Player::begin`] or [`Player::restore`].
    pub fn new(
        spec: &PolicySpec,
        inputs: Inputs,
        n_envs: usize,
        episodes_per_trial: u32,
        normalisers: Normalisers,
        role: PlayerRole,
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
            previous: PreviousStep::new(spec, n_envs),
            bytes: vec![0; 4 * n_envs * spec.action.width()],
            values: Vec::new(),
        }
    }

    /// Makes the player sample continuous actions uniformly, see [`Actor::act_uniformly`].
    #[must_use]
    pub fn uniformly(mut self) -> Self {
        self.actor.act_uniformly();
        self
    }

    /// Adds normally distributed noise with the standard deviation `noise`, at least 0, to normalised observations in
    /// training. The previous step in RL²'s inputs gets no noise.
    #[must_use]
    pub fn with_noise(self, noise: f64) -> Self {
        Self { noise, ..self }
    }

    /// Makes the player cache the activations of `n_steps` steps, see [`Actor::keep_activations`].
    #[must_use]
    pub fn keeping_activations(mut self, n_steps: usize) -> Self {
        self.actor.keep_activations(n_steps);
        self
    }

    /// Returns N, the number of environments.
    pub fn n_envs(&self) -> usize {
        self.starts.len()
    }

    /// Returns the number of episodes in a trial.
    pub fn episodes_per_trial(&self) -> u32 {
        self.episodes_per_trial
    }

    /// Returns O, the length of an observation.
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Loads all weights as one array `[P]`, and keeps the policy's memory.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length) if the number of weights is wrong.
    pub fn load(&mut self, weights: &[f32]) -> Result<()> {
        self.actor.load_flat(weights)
    }

    /// Lets `backend` take over the networks with which this player acts, see [`GradientBackend::reuse_activations`].
    /// Call [`Player::load`] before this player acts again.
    pub fn give_activations(&mut self, backend: &mut dyn GradientBackend) {
        backend.reuse_activations(&mut self.actor);
    }

    /// Begins a trial in every environment, whose first observations are `observations` `[N, O]`. In training, adds the
    /// observations to the statistics, but only those of environments whose next step is collected according to
    /// `remaining`.
    ///
    /// # Errors
    /// An error if the length is wrong or an observation is not finite.
    pub fn begin(&mut self, observations: &[f32], remaining: Option<&RemainingRollout>) -> Result<()> {
        check_length("observations [N, O]", observations.len(), self.observations.len())?;
        self.observations.copy_from_slice(observations);
        let active = remaining.and_then(RemainingRollout::active);
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

    /// Replaces the observation of the environment `slot` by `observation` `[O]`, which is normalised without changing
    /// the statistics. Call it after the environment was set to another state.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length) if the observation has the wrong length.
    pub fn replace_observation(&mut self, slot: usize, observation: &[f32]) -> Result<()> {
        check_length("observation [O]", observation.len(), self.observation_size)?;
        let row = &mut self.observations[slot * self.observation_size..][..self.observation_size];
        row.copy_from_slice(observation);
        self.normalisers.normalise(row)
    }

    /// Begins trial `trial_index` of a test with `seed` in the environment `slot`. Clears the policy's memory. The
    /// trial's sampled actions then depend only on the seed, the environment index and the trial index.
    pub fn begin_trial(&mut self, slot: usize, seed: u64, trial_index: u64) {
        self.actor.forget(slot);
        self.inputs.forget(slot);
        if let PlayerRole::Testing(trials) = &mut self.role {
            trials.streams[slot] = trial_stream(seed, Purpose::TestActions, trials.indices[slot], trial_index);
        }
    }

    /// Chooses the next actions and returns them in the encoding of the protocol, see [`ActorOutput::write_bytes`].
    ///
    /// # Errors
    /// [`Error::PolicyOutput`](crate::Error::PolicyOutput) if an output of the policy is not finite.
    pub fn act(&mut self) -> Result<&[u8]> {
        let Self { actor, inputs, role, observations, starts, previous, bytes, .. } = self;
        let rows = inputs.from_observations(observations);
        actor.act(rows, role, &mut previous.acts)?;
        previous.acted_on.clear();
        previous.acted_on.extend_from_slice(rows);
        previous.starts.copy_from_slice(starts);
        previous.acts.write_bytes(bytes);
        Ok(bytes)
    }

    /// Returns the last actions in the encoding of the protocol.
    pub fn actions(&self) -> &[u8] {
        &self.bytes
    }

    /// Takes the results of the last actions. In training, adds rewards and observations to the statistics, but only
    /// those of environments whose steps are collected according to `remaining`. Call `remaining.advance` before this
    /// method.
    ///
    /// # Errors
    /// An error if an array has the wrong length or a number is not finite.
    pub fn observe(&mut self, outcome: &StepOutcome<'_>, remaining: Option<&RemainingRollout>) -> Result<()> {
        let n_envs = self.starts.len();
        check_length("observations [N, O]", outcome.observations.len(), self.observations.len())?;
        check_length("rewards [N]", outcome.rewards.len(), n_envs)?;
        check_length("terminated [N]", outcome.terminated.len(), n_envs)?;
        check_length("truncated [N]", outcome.truncated.len(), n_envs)?;
        let finals = outcome.ended.len() * self.observation_size;
        check_length("final_observations [K, O]", outcome.final_observations.len(), finals)?;
        self.previous.take(outcome, self.episodes_per_trial);

        let Self { actor, inputs, role, normalisers, previous, observations, .. } = self;
        let statistics = role.statistics();
        let stepped = remaining.and_then(RemainingRollout::stepped);
        observations.copy_from_slice(outcome.observations);
        normalisers.take_rewards(&mut previous.rewards, &previous.trial_ended, statistics, stepped)?;
        normalisers.take_observations(observations, statistics, remaining.and_then(RemainingRollout::active))?;
        inputs.remember(&previous.acts, &previous.rewards, &previous.done)?;
        // In training, computes the values of the final observations of truncated episodes.
        if statistics == Statistics::Running && previous.gather_truncated(outcome, self.observation_size) {
            normalisers.normalise(&mut previous.finals)?;
            actor.values_in(
                inputs.from_final_observations(&previous.finals, &previous.truncated_slots),
                &previous.truncated_slots,
                &mut self.values,
            )?;
            let values = previous.truncated_slots.iter().zip(&self.values);
            values.for_each(|(&slot, value)| previous.truncation_values[slot] = *value);
        }
        let seed = if let PlayerRole::Testing(trials) = &self.role { trials.seed } else { 0 };
        for end in outcome.ended {
            if self.previous.trial_ended[end.slot] {
                self.begin_trial(end.slot, seed, end.trial_index + 1);
            }
        }
        self.starts.copy_from_slice(&self.previous.trial_ended);
        self.add_noise();
        Ok(())
    }

    fn add_noise(&mut self) {
        if let (PlayerRole::Training(stream), true) = (&mut self.role, self.noise > 0.0) {
            self.observations.iter_mut().for_each(|x| *x += (self.noise * normal(stream)) as f32);
        }
    }

    /// Returns the last step: the actions that [`Player::act`] chose and the results that [`Player::observe`] took.
    pub fn played(&self) -> RolloutStep<'_> {
        let step = &self.previous;
        RolloutStep {
            observations: &step.acted_on,
            starts: &step.starts,
            actions: &step.acts.actions,
            log_probs: &step.acts.log_probs,
            values: &step.acts.values,
            rewards: &step.rewards,
            terminated: &step.terminated,
            truncated: &step.truncated,
            truncation_values: &step.truncation_values,
        }
    }

    /// Returns the values V `[N]` of the current observations, from which a rollout of steps is bootstrapped. Returns 0
    /// after a rollout of complete episodes, because no step follows them.
    ///
    /// # Errors
    /// An error if the policy must first load weights.
    pub fn last_values(&mut self, remaining: &RemainingRollout) -> Result<&[f32]> {
        match remaining {
            RemainingRollout::Steps(_) => {
                self.actor.values(self.inputs.from_observations(&self.observations), &mut self.values)?;
            }
            RemainingRollout::Episodes(_) => {
                self.values.clear();
                self.values.resize(self.starts.len(), 0.0);
            }
        }
        Ok(&self.values)
    }

    /// Returns the policy's memory of every environment, `[N, S]`.
    pub fn memory(&self) -> &[f32] {
        self.actor.memory()
    }

    /// Returns the role: the random numbers for actions, and whether statistics are updated.
    pub fn role(&self) -> &PlayerRole {
        &self.role
    }

    /// Returns the normalisers with the statistics so far.
    pub fn normalisers(&self) -> &Normalisers {
        &self.normalisers
    }

    /// Returns the player's state between two steps, for [`Player::restore`]. `None` in a test.
    pub fn state(&self) -> Option<PlayerTrainingState> {
        let PlayerRole::Training(actions) = &self.role else { return None };
        Some(PlayerTrainingState {
            observations: self.observations.clone(),
            starts: self.starts.clone(),
            previous_steps: self.inputs.previous_steps().to_vec(),
            memory: self.actor.memory().to_vec(),
            actions: actions.clone(),
        })
    }

    /// Restores a state that [`Player::state`] returned. The player then has the training role.
    ///
    /// # Errors
    /// [`Error::Length`](crate::Error::Length) if an array does not fit.
    pub fn restore(&mut self, state: &PlayerTrainingState) -> Result<()> {
        let PlayerTrainingState { observations, starts, previous_steps, memory, actions } = state;
        check_length("observations [N, O]", observations.len(), self.observations.len())?;
        check_length("starts [N]", starts.len(), self.starts.len())?;
        self.inputs.restore(previous_steps)?;
        self.actor.set_memory(memory)?;
        self.observations.copy_from_slice(observations);
        self.starts.copy_from_slice(starts);
        self.role = PlayerRole::Training(actions.clone());
        Ok(())
    }
}

impl PreviousStep {
    fn new(spec: &PolicySpec, n_envs: usize) -> Self {
        Self {
            acted_on: Vec::with_capacity(n_envs * spec.observation_size),
            starts: vec![true; n_envs],
            acts: ActorOutput::new(spec.action, n_envs),
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

    /// Copies rewards and flags from `outcome`. Clears the flags of episodes that ended within a trial.
    fn take(&mut self, outcome: &StepOutcome<'_>, episodes_per_trial: u32) {
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

    /// Collects the final observations of truncated episodes. Returns whether there are any.
    fn gather_truncated(&mut self, outcome: &StepOutcome<'_>, observation_size: usize) -> bool {
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
