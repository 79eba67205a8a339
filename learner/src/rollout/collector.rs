//! Collecting rollouts from a session.

use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_chacha::ChaCha8Rng;

use super::{Rollout, RolloutStep};
use crate::client::{ClientError, EndedEpisode, Session, StepReply};
use crate::error::check_length;
use crate::policy::{Actor, Acts, ObservationNormaliser, PolicySpec, RewardNormaliser, Weights};
use crate::random::{Purpose, stream};

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

/// Steps N environments with a policy and fills rollouts; episodes run on from one rollout to the next, and with them
/// what a recurrent policy remembers, which is emptied where an episode ends.
///
/// Every training step updates the statistics of observations and rewards, and is normalised with the updated ones, as
/// stable-baselines3's VecNormalize does. Final observations are normalised with the same statistics.
#[derive(Debug)]
pub struct Collector<'a> {
    session: Session<'a>,
    actor: Actor,
    rng: ChaCha8Rng,
    normalisers: Normalisers,
    observation_size: usize,
    /// `[N, O]` normalised observations that the next actions are chosen on.
    observations: Vec<f32>,
    /// `[N]` whether those are the first of an episode.
    starts: Vec<bool>,
    times: Times,
    // Buffers of a step.
    reply: StepReply,
    acts: Acts,
    actions: Vec<u8>,
    done: Vec<bool>,
    finals: Vec<f32>,
    truncated: Vec<usize>,
    final_values: Vec<f32>,
    truncation_values: Vec<f32>,
}

/// Statistics of a training; `None` where nothing is normalised.
#[derive(Clone, Debug, PartialEq)]
pub struct Normalisers {
    /// Of observations.
    pub observations: Option<ObservationNormaliser>,
    /// Of rewards.
    pub rewards: Option<RewardNormaliser>,
}

/// Everything beside its statistics that a collector's future depends on, for exact resumption.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectorState {
    /// `[N]` the environments.
    pub snapshots: Vec<Bytes>,
    /// `[N, O]` normalised observations that the next actions are chosen on.
    pub observations: Vec<f32>,
    /// `[N]` whether those are the first of an episode.
    pub starts: Vec<bool>,
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
    /// Collects from `session`, whose first observations `[N, O]` are given. `seed` fixes the sampled actions.
    ///
    /// # Errors
    /// [`CollectError::Numbers`] if an observation is not finite.
    pub fn new(
        session: Session<'a>,
        mut first_observations: Vec<f32>,
        spec: &PolicySpec,
        mut normalisers: Normalisers,
        seed: u64,
    ) -> Result<Self, CollectError> {
        let num_envs = session.num_envs();
        normalisers.take_observations(&mut first_observations)?;
        Ok(Self {
            observation_size: session.observation_size(),
            session,
            actor: Actor::new(spec, num_envs),
            rng: stream(seed, Purpose::Actions),
            normalisers,
            observations: first_observations,
            starts: vec![true; num_envs],
            times: Times::default(),
            reply: StepReply::default(),
            acts: Acts::new(spec.action, num_envs),
            actions: Vec::new(),
            done: vec![false; num_envs],
            finals: Vec::new(),
            truncated: Vec::new(),
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
        normalisers: Normalisers,
        state: &CollectorState,
    ) -> Result<Self, CollectError> {
        let CollectorState { snapshots, observations, starts, memory, actions } = state;
        let (num_envs, size) = (session.num_envs(), session.observation_size());
        check_length("observations [N, O]", observations.len(), num_envs * size)?;
        check_length("starts [N]", starts.len(), num_envs)?;
        let none = Normalisers { observations: None, rewards: None };
        let mut collector = Self::new(session, vec![0.0; num_envs * size], spec, none, 0)?;
        // The observations that come back are those of `observations` before normalisation.
        collector.session.restore(snapshots, &mut collector.observations)?;
        collector.observations.copy_from_slice(observations);
        collector.starts.copy_from_slice(starts);
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
        weights: &Weights,
        rollout: &mut Rollout,
        mut on_episode: impl FnMut(&EndedEpisode),
    ) -> Result<(), CollectError> {
        let start = Instant::now();
        let waited_before = self.times.waiting;
        self.actor.load(weights)?;
        rollout.begin(self.actor.memory());
        while !rollout.is_full() {
            self.actor.act(&self.observations, &mut self.rng, &mut self.acts)?;
            self.acts.write_bytes(&mut self.actions);
            let sent = Instant::now();
            self.session.step(&self.actions, &mut self.reply)?;
            self.times.waiting += sent.elapsed();
            self.store(rollout)?;
            self.reply.ended.iter().for_each(&mut on_episode);
        }
        self.actor.values(&self.observations, &mut self.final_values)?;
        rollout.finish(&self.final_values)?;
        self.times.acting += start.elapsed().saturating_sub(self.times.waiting - waited_before);
        Ok(())
    }

    /// Normalises what came back and appends the step; the observations become those of the next step.
    fn store(&mut self, rollout: &mut Rollout) -> Result<(), CollectError> {
        let reply = &mut self.reply;
        for (done, (terminated, truncated)) in self.done.iter_mut().zip(reply.terminated.iter().zip(&reply.truncated)) {
            *done = *terminated || *truncated;
        }
        self.normalisers.take_observations(&mut reply.observations)?;
        self.normalisers.take_rewards(&mut reply.rewards, &self.done)?;

        self.truncation_values.fill(0.0);
        let finals = reply.final_observations.chunks_exact(self.observation_size);
        self.finals.clear();
        self.truncated.clear();
        for (end, observation) in reply.ended.iter().zip(finals).filter(|(end, _)| reply.truncated[end.slot]) {
            self.finals.extend_from_slice(observation);
            self.truncated.push(end.slot);
        }
        if !self.finals.is_empty() {
            self.normalisers.normalise(&mut self.finals)?;
            self.actor.values_in(&self.finals, &self.truncated, &mut self.final_values)?;
            let values = self.truncated.iter().zip(&self.final_values);
            values.for_each(|(&slot, value)| self.truncation_values[slot] = *value);
        }
        rollout.push(RolloutStep {
            observations: &self.observations,
            starts: &self.starts,
            actions: &self.acts.actions,
            log_probs: &self.acts.log_probs,
            values: &self.acts.values,
            rewards: &reply.rewards,
            terminated: &reply.terminated,
            truncated: &reply.truncated,
            truncation_values: &self.truncation_values,
        })?;
        std::mem::swap(&mut self.observations, &mut reply.observations);
        reply.ended.iter().for_each(|end| self.actor.forget(end.slot));
        self.starts.copy_from_slice(&self.done);
        Ok(())
    }
}

impl Normalisers {
    /// Adds `observations` `[N, O]` to the statistics and normalises them.
    fn take_observations(&mut self, observations: &mut [f32]) -> crate::error::Result<()> {
        match &mut self.observations {
            Some(normaliser) => normaliser.update(observations).and_then(|()| normaliser.normalise(observations)),
            None => Ok(()),
        }
    }

    /// Adds `rewards` `[N]` to the statistics and normalises them.
    fn take_rewards(&mut self, rewards: &mut [f32], done: &[bool]) -> crate::error::Result<()> {
        if let Some(normaliser) = &mut self.rewards {
            normaliser.update(rewards, done)?;
            normaliser.normalise(rewards);
        }
        Ok(())
    }

    /// Normalises `observations`; the statistics stay.
    fn normalise(&self, observations: &mut [f32]) -> crate::error::Result<()> {
        self.observations.as_ref().map_or(Ok(()), |normaliser| normaliser.normalise(observations))
    }
}
