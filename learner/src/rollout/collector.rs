//! Collecting rollouts from a session.

use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_chacha::ChaCha8Rng;

use super::{Normalisers, Rollout, RolloutStep};
use crate::client::{ClientError, EndedEpisode, Session, StepReply};
use perturb_policy::random::{Purpose, stream};
use perturb_policy::{Actor, Acts, Inputs, PolicySpec, check_length};

/// Why a rollout could not be collected.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CollectError {
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// A number is not finite, or an array has the wrong size.
    #[error(transparent)]
    Numbers(#[from] crate::error::Error),
}

impl From<perturb_policy::Error> for CollectError {
    fn from(error: perturb_policy::Error) -> Self {
        Self::Numbers(error.into())
    }
}

impl CollectError {
    /// Whether the same may go well later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        matches!(self, Self::Client(error) if error.can_be_retried())
    }
}

/// Steps N environments with a policy and fills rollouts: with T steps of each, where episodes run on from one rollout to
/// the next, and with them what a recurrent policy remembers ([`Collector::collect`]); or with complete episodes
/// ([`Collector::collect_episodes`]).
///
/// Memories are emptied where a trial ends. In a trial of one episode that is the episode's end. In a trial of several
/// (RL²) the policy's inputs tell it of the ends in between, and to the rollout, and so to returns and advantages, the
/// trial is one episode: flags of ends in between are left out, and the discounted returns that rewards are divided by
/// run on.
///
/// Every training step updates the statistics of observations and rewards, and is normalised with the updated ones, as
/// stable-baselines3's VecNormalize does. Final observations are normalised with the same statistics.
#[derive(Debug)]
pub struct Collector<'a> {
    session: Session<'a>,
    actor: Actor,
    inputs: Inputs,
    rng: ChaCha8Rng,
    normalisers: Normalisers,
    observation_size: usize,
    /// `[N, O]` normalised observations that the next actions are chosen on.
    observations: Vec<f32>,
    /// `[N]` whether those are the first of a trial.
    starts: Vec<bool>,
    /// `[N, I]` inputs that the last actions were chosen on.
    acted_on: Vec<f32>,
    times: Times,
    // Buffers of a step.
    reply: StepReply,
    acts: Acts,
    actions: Vec<u8>,
    /// `[N]` whether an episode ended.
    done: Vec<bool>,
    /// `[N]` whether the task, or the time limit, ended a trial's last episode.
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    /// `[N]` whether either did.
    trial_ended: Vec<bool>,
    finals: Vec<f32>,
    truncated_slots: Vec<usize>,
    final_values: Vec<f32>,
    truncation_values: Vec<f32>,
}

/// Everything beside its statistics that a collector's future depends on, for exact resumption.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectorState {
    /// `[N]` the environments.
    pub snapshots: Vec<Bytes>,
    /// `[N, O]` normalised observations that the next actions are chosen on.
    pub observations: Vec<f32>,
    /// `[N]` whether those are the first of a trial.
    pub starts: Vec<bool>,
    /// `[N, E]` what stands beside the observations, see [`Inputs`].
    pub outcomes: Vec<f32>,
    /// `[N, S]` what the policy remembers; empty for a feed-forward policy.
    pub memory: Vec<f32>,
    /// The stream of sampled actions.
    pub actions: ChaCha8Rng,
}

/// Where the time of collecting went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Times {
    /// Choosing actions, normalising, storing.
    pub acting: Duration,
    /// Waiting for the servers' replies.
    pub waiting: Duration,
}

impl<'a> Collector<'a> {
    /// Collects from `session`, whose first observations `[N, O]` are given. `inputs` are those of a policy of `spec`,
    /// fresh. `seed` fixes the sampled actions.
    ///
    /// # Errors
    /// [`CollectError::Numbers`] if an observation is not finite.
    pub fn new(
        session: Session<'a>,
        mut first_observations: Vec<f32>,
        spec: &PolicySpec,
        inputs: Inputs,
        mut normalisers: Normalisers,
        seed: u64,
    ) -> Result<Self, CollectError> {
        let num_envs = session.num_envs();
        normalisers.take_observations(&mut first_observations, None)?;
        Ok(Self {
            observation_size: session.observation_size(),
            session,
            actor: Actor::new(spec, num_envs),
            inputs,
            rng: stream(seed, Purpose::Actions),
            normalisers,
            observations: first_observations,
            starts: vec![true; num_envs],
            acted_on: Vec::new(),
            times: Times::default(),
            reply: StepReply::default(),
            acts: Acts::new(spec.action, num_envs),
            actions: Vec::new(),
            done: vec![false; num_envs],
            terminated: vec![false; num_envs],
            truncated: vec![false; num_envs],
            trial_ended: vec![false; num_envs],
            finals: Vec::new(),
            truncated_slots: Vec::new(),
            final_values: Vec::new(),
            truncation_values: vec![0.0; num_envs],
        })
    }

    /// The state between two rollouts.
    ///
    /// # Errors
    /// [`CollectError::Client`].
    pub fn state(&mut self) -> Result<CollectorState, CollectError> {
        Ok(CollectorState {
            snapshots: self.session.snapshot()?,
            observations: self.observations.clone(),
            starts: self.starts.clone(),
            outcomes: self.inputs.outcomes().to_vec(),
            memory: self.actor.memory().to_vec(),
            actions: self.rng.clone(),
        })
    }

    /// Goes on from a saved state, whose `normalisers` are given: later rollouts are those that followed it. `session` is
    /// one of the same environment with as many of them, on any number of servers.
    ///
    /// # Errors
    /// [`CollectError::Numbers`] if an array does not fit, [`CollectError::Client`] if a snapshot does not.
    pub fn resume(
        session: Session<'a>,
        spec: &PolicySpec,
        inputs: Inputs,
        normalisers: Normalisers,
        state: &CollectorState,
    ) -> Result<Self, CollectError> {
        let CollectorState { snapshots, observations, starts, outcomes, memory, actions } = state;
        let (num_envs, size) = (session.num_envs(), session.observation_size());
        check_length("observations [N, O]", observations.len(), num_envs * size)?;
        check_length("starts [N]", starts.len(), num_envs)?;
        let none = Normalisers { observations: None, rewards: None };
        let mut collector = Self::new(session, vec![0.0; num_envs * size], spec, inputs, none, 0)?;
        // The observations that come back are those of `observations` before normalisation.
        collector.session.restore(snapshots, &mut collector.observations)?;
        collector.observations.copy_from_slice(observations);
        collector.starts.copy_from_slice(starts);
        collector.inputs.restore(outcomes)?;
        collector.actor.set_memory(memory)?;
        collector.rng = actions.clone();
        collector.normalisers = normalisers;
        Ok(collector)
    }

    /// The statistics so far.
    pub fn normalisers(&self) -> &Normalisers {
        &self.normalisers
    }

    /// Where the time of all rollouts went.
    pub fn times(&self) -> Times {
        self.times
    }

    /// Fills `rollout` with new steps under the policy of `weights`; gives every episode that ended to `on_episode`.
    ///
    /// # Errors
    /// [`CollectError`]; what was collected of this rollout is lost.
    pub fn collect(
        &mut self,
        weights: &[f32],
        rollout: &mut Rollout,
        mut on_episode: impl FnMut(&EndedEpisode),
    ) -> Result<(), CollectError> {
        self.timed(|collector| {
            collector.actor.load_flat(weights)?;
            rollout.begin(collector.actor.memory());
            while !rollout.is_full() {
                collector.step()?;
                collector.normalise(None, None)?;
                collector.store(rollout)?;
                collector.reply.ended.iter().for_each(&mut on_episode);
            }
            let Self { actor, inputs, observations, final_values, .. } = collector;
            actor.values(inputs.of(observations), final_values)?;
            Ok(rollout.finish(final_values)?)
        })
    }

    /// Breaks off what runs, and fills `rollout` with `count` new complete episodes under the policy of `weights`; gives
    /// each to `on_episode` as it ends.
    ///
    /// How many episodes each environment contributes is fixed beforehand, as evenly as possible: to take the first to
    /// end instead would favour short ones. An environment that has done its part goes on unseen, neither stored as an
    /// episode nor part of any statistics.
    ///
    /// # Errors
    /// [`CollectError`]; what was collected of this rollout is lost.
    pub fn collect_episodes(
        &mut self,
        weights: &[f32],
        count: usize,
        rollout: &mut Rollout,
        mut on_episode: impl FnMut(&EndedEpisode),
    ) -> Result<(), CollectError> {
        self.timed(|collector| {
            let n_envs = collector.starts.len();
            let mut due: Vec<usize> = (0..n_envs).map(|i| count / n_envs + usize::from(i < count % n_envs)).collect();
            let mut active: Vec<bool> = due.iter().map(|&due| due > 0).collect();
            let mut stepped = active.clone();
            collector.actor.load_flat(weights)?;
            collector.reset(&active)?;
            rollout.begin(collector.actor.memory());
            while active.contains(&true) {
                collector.step()?;
                stepped.copy_from_slice(&active);
                for end in collector.reply.ended.iter().filter(|end| stepped[end.slot]) {
                    due[end.slot] -= 1;
                    active[end.slot] = due[end.slot] > 0;
                }
                // What was observed after an environment's last episode begins one that is not seen.
                collector.normalise(Some(&stepped), Some(&active))?;
                collector.store(rollout)?;
                for end in collector.reply.ended.iter().filter(|end| stepped[end.slot]) {
                    rollout.note_episode(end.slot, end.length as usize, end.episode_return)?;
                    on_episode(end);
                }
            }
            collector.final_values.clear();
            collector.final_values.resize(n_envs, 0.0); // every episode is complete: nothing follows
            Ok(rollout.finish(&collector.final_values)?)
        })
    }

    /// Does `work`; all of its time but that of waiting is that of acting.
    fn timed(&mut self, work: impl FnOnce(&mut Self) -> Result<(), CollectError>) -> Result<(), CollectError> {
        let start = Instant::now();
        let waited_before = self.times.waiting;
        work(self)?;
        self.times.acting += start.elapsed().saturating_sub(self.times.waiting - waited_before);
        Ok(())
    }

    /// A new episode in every environment; the statistics take in those of the `active` ones.
    fn reset(&mut self, active: &[bool]) -> Result<(), CollectError> {
        let sent = Instant::now();
        self.session.reset(&mut self.observations)?;
        self.times.waiting += sent.elapsed();
        self.normalisers.take_observations(&mut self.observations, Some(active))?;
        if let Some(normaliser) = &mut self.normalisers.rewards {
            normaliser.reset_returns();
        }
        self.starts.fill(true);
        for slot in 0..self.starts.len() {
            self.actor.forget(slot);
            self.inputs.forget(slot);
        }
        Ok(())
    }

    /// Chooses actions and has the environments take them.
    fn step(&mut self) -> Result<(), CollectError> {
        let inputs = self.inputs.of(&self.observations);
        self.actor.act(inputs, &mut self.rng, &mut self.acts)?;
        self.acted_on.clear();
        self.acted_on.extend_from_slice(inputs);
        self.acts.write_bytes(&mut self.actions);
        let sent = Instant::now();
        self.session.step(&self.actions, &mut self.reply)?;
        self.times.waiting += sent.elapsed();

        let Self { session, reply, done, terminated, truncated, trial_ended, .. } = self;
        terminated.copy_from_slice(&reply.terminated);
        truncated.copy_from_slice(&reply.truncated);
        done.fill(false);
        for end in &reply.ended {
            done[end.slot] = true;
            if end.episode_in_trial + 1 < session.episodes_per_trial() {
                (terminated[end.slot], truncated[end.slot]) = (false, false);
            }
        }
        let flags = terminated.iter().zip(&*truncated);
        trial_ended.iter_mut().zip(flags).for_each(|(ended, (a, b))| *ended = *a || *b);
        Ok(())
    }

    /// Normalises what came back, after the statistics have taken in the rewards of the environments that `stepped`, and
    /// the observations of those that will be `active` in the next step; or all.
    fn normalise(&mut self, stepped: Option<&[bool]>, active: Option<&[bool]>) -> Result<(), CollectError> {
        let Self { reply, normalisers, trial_ended, .. } = self;
        normalisers.take_rewards(&mut reply.rewards, trial_ended, stepped)?;
        normalisers.take_observations(&mut reply.observations, active)?;
        Ok(())
    }

    /// Appends the step; the observations become those of the next step, and memories end with trials.
    fn store(&mut self, rollout: &mut Rollout) -> Result<(), CollectError> {
        let reply = &mut self.reply;
        self.inputs.remember(&self.acts, &reply.rewards, &self.done)?;
        self.truncation_values.fill(0.0);
        let finals = reply.final_observations.chunks_exact(self.observation_size);
        self.finals.clear();
        self.truncated_slots.clear();
        for (end, observation) in reply.ended.iter().zip(finals).filter(|(end, _)| self.truncated[end.slot]) {
            self.finals.extend_from_slice(observation);
            self.truncated_slots.push(end.slot);
        }
        if !self.finals.is_empty() {
            self.normalisers.normalise(&mut self.finals)?;
            let inputs = self.inputs.of_finals(&self.finals, &self.truncated_slots);
            self.actor.values_in(inputs, &self.truncated_slots, &mut self.final_values)?;
            let values = self.truncated_slots.iter().zip(&self.final_values);
            values.for_each(|(&slot, value)| self.truncation_values[slot] = *value);
        }
        rollout.push(RolloutStep {
            observations: &self.acted_on,
            starts: &self.starts,
            actions: &self.acts.actions,
            log_probs: &self.acts.log_probs,
            values: &self.acts.values,
            rewards: &reply.rewards,
            terminated: &self.terminated,
            truncated: &self.truncated,
            truncation_values: &self.truncation_values,
        })?;
        std::mem::swap(&mut self.observations, &mut reply.observations);
        for (slot, _) in self.trial_ended.iter().enumerate().filter(|(_, ended)| **ended) {
            self.actor.forget(slot);
            self.inputs.forget(slot);
        }
        self.starts.copy_from_slice(&self.trial_ended);
        Ok(())
    }
}
