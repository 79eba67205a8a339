//! A trained policy as it acts in tests: sampled actions, frozen statistics.

use perturb_policy::random::{Purpose, trial_stream};
use rand_chacha::ChaCha8Rng;

use crate::checkpoint::{Checkpoint, State};
use perturb_policy::{Actor, Acts, Inputs, Result};

/// The policy of a checkpoint in N environments, with what it remembers of each.
pub struct Agent<'a> {
    state: &'a State,
    actor: Actor,
    inputs: Inputs,
    /// Of its actions' randomness.
    seed: u64,
    /// One for each environment, of its present trial.
    streams: Vec<ChaCha8Rng>,
    acts: Acts,
    bytes: Vec<u8>,
}

impl<'a> Agent<'a> {
    /// At the start of the first trial in each of N = `n_envs` environments, whose indices are 0 … N-1. `seed` fixes the
    /// actions that are sampled.
    ///
    /// # Errors
    /// Weights that do not fit.
    pub fn new(checkpoint: &'a Checkpoint, n_envs: usize, seed: u64) -> Result<Self> {
        let state = &checkpoint.state;
        let mut actor = Actor::new(&checkpoint.policy, n_envs);
        actor.load(&checkpoint.weights)?;
        let first = |environment: usize| trial_stream(seed, Purpose::TestActions, environment as u32, 0);
        Ok(Self {
            state,
            actor,
            inputs: state.inputs(n_envs),
            seed,
            streams: (0..n_envs).map(first).collect(),
            acts: Acts::new(checkpoint.policy.action, n_envs),
            bytes: Vec::new(),
        })
    }

    /// The next actions, as the protocol wants them, after `observations` `[N, O]`, which are normalised in place.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub fn act(&mut self, observations: &mut [f32]) -> Result<&[u8]> {
        if let Some(normaliser) = &self.state.observation_normaliser {
            normaliser.normalise(observations)?;
        }
        self.actor.act(self.inputs.of(observations), &mut self.streams, &mut self.acts)?;
        self.acts.write_bytes(&mut self.bytes);
        Ok(&self.bytes)
    }

    /// Remembers what came of the last actions: `rewards` `[N]`, which are normalised in place, and `done` `[N]` where an
    /// episode ended.
    ///
    /// # Errors
    /// Lengths that do not fit.
    pub fn remember(&mut self, rewards: &mut [f32], done: &[bool]) -> Result<()> {
        if let Some(normaliser) = &self.state.reward_normaliser {
            normaliser.normalise(rewards);
        }
        self.inputs.remember(&self.acts, rewards, done)
    }

    /// Trial `trial_index` begins in `environment`: nothing before it is remembered, and its address alone says which
    /// actions are sampled.
    pub fn begin_trial(&mut self, environment: usize, trial_index: u64) {
        self.begin_trial_of(environment, self.seed, trial_index);
    }

    /// The same of a trial that belongs to another seed.
    pub fn begin_trial_of(&mut self, environment: usize, seed: u64, trial_index: u64) {
        self.actor.forget(environment);
        self.inputs.forget(environment);
        self.streams[environment] = trial_stream(seed, Purpose::TestActions, environment as u32, trial_index);
    }
}
