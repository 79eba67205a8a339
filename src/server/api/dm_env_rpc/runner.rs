//! Runs a world's episodes on the pool, in a batch of one environment.

use super::Error;
use crate::{
    env::{Distribution, EnvironmentSpec, EpisodeSettings, StartedEpisode, Version},
    pool::{Batch, BatchSettings, Pool, ResetEntry, StepResult},
    proto::dm_env_rpc::v1::EnvironmentStateType as State,
    server::audit::draws::DrawAuditor,
};
use bytes::Bytes;
use std::sync::Arc;

/// A world's environment and the state of its current episode.
pub(super) struct Runner {
    batch: Batch,
    draws: DrawAuditor,
    phase: EpisodePhase,
    /// The first observation of the latest episode, f32 `[O]`.
    first: Bytes,
    start: Option<StartedEpisode>,
    seed: u64,
    version: Version,
}

/// The state of the current episode.
#[derive(Clone, Copy, PartialEq, Eq)]
enum EpisodePhase {
    /// The world is new: its first episode has begun, but no agent has seen it yet.
    Unseen,
    /// The episode is running.
    Running,
    /// The episode ended or was interrupted.
    Over,
}

/// The outcome of a step, with everything that an agent may request.
pub(super) struct WorldStep {
    /// The protocol's state: running, terminated or interrupted.
    pub(super) state: State,
    /// The observation after the step, f32 `[O]`, little-endian.
    pub(super) observation: Bytes,
    /// The reward; 0 with the first observation of an episode.
    pub(super) reward: f32,
    /// Whether the step limit ended the episode.
    pub(super) truncated: bool,
    /// Whether the episode has ended with success.
    pub(super) success: bool,
    /// Whether the physics diverged in this step.
    pub(super) diverged: bool,
}

/// Changes that take effect when the next episode begins.
#[derive(Clone)]
pub(super) struct Changes {
    /// The version of the next episode.
    pub(super) version: Version,
    /// The new seed; `None` keeps the seed.
    pub(super) seed: Option<u64>,
    /// The new distributions, one for each parameter; `None` keeps the distributions.
    pub(super) distributions: Option<Arc<[Distribution]>>,
}

impl Runner {
    /// Creates the environment of a new world.
    ///
    /// # Errors
    /// If the pool is full, a model cannot be loaded, the token may not draw from these distributions, or the ledger
    /// cannot be written.
    pub(super) async fn open(
        pool: &Pool,
        settings: BatchSettings,
        version: Version,
        draws: DrawAuditor,
    ) -> Result<Self, Error> {
        let (begun, spec) = (draws.open(&settings).await?, settings.spec);
        let opened = Batch::open(pool, settings).await;
        let (mut batch, first, started) = opened.inspect_err(|_| draws.open_failed(spec, begun))?;
        draws.record_drop(&mut batch);
        let seed = batch.settings().groups[0].episodes.seed;
        Ok(Self { batch, draws, phase: EpisodePhase::Unseen, first, start: only(started), seed, version })
    }

    /// The episode settings with which the world was created.
    pub(super) fn episodes(&self) -> &EpisodeSettings {
        &self.batch.settings().groups[0].episodes
    }

    /// The auditor of the world's draws.
    pub(super) fn draws(&self) -> &DrawAuditor {
        &self.draws
    }

    /// The description of the environment.
    pub(super) fn spec(&self) -> &'static EnvironmentSpec {
        self.batch.settings().spec
    }

    /// The start of the latest episode, with its receipt.
    pub(super) fn start(&self) -> Option<&StartedEpisode> {
        self.start.as_ref()
    }

    /// The seed of the latest episode.
    pub(super) fn seed(&self) -> u64 {
        self.seed
    }

    /// The version of the latest episode.
    pub(super) fn version(&self) -> Version {
        self.version
    }

    /// Whether an episode is running. If so, the next step advances it; otherwise the next step begins an episode.
    pub(super) fn is_running(&self) -> bool {
        self.phase == EpisodePhase::Running
    }

    /// Interrupts the running episode, if any. The next step then begins another episode.
    pub(super) fn stop(&mut self) {
        if self.is_running() {
            self.phase = EpisodePhase::Over;
        }
    }

    /// Waits for a step that is still running although its stream has ended.
    pub(super) async fn finish_abandoned(&mut self) {
        self.batch.finish_abandoned().await;
    }

    /// Begins the next episode, and returns its first observation. The first episode of a new world began when the
    /// world was created. So the first call only returns the first observation of this episode, unless there are
    /// changes. If there are changes, a new trial begins.
    ///
    /// # Errors
    /// If the token may not draw from the new distributions, the ledger cannot be written, or the server has a defect.
    pub(super) async fn begin(&mut self, changes: Changes) -> Result<WorldStep, Error> {
        let Changes { version, seed, distributions } = changes;
        // The first episode of a new world has already begun. Unless there are changes, it needs no reset.
        if self.phase != EpisodePhase::Unseen || seed.is_some() || distributions.is_some() {
            let entries = vec![ResetEntry { slot: 0, seed, distributions, state: None }];
            self.draws.reset(&self.batch, &entries).await?;
            // These fields are set before the reset, so that the next call resets again if the reset fails.
            (self.phase, self.version, self.seed) = (EpisodePhase::Over, version, seed.unwrap_or(self.seed));
            let (first, started) = self.batch.reset(entries).await?;
            (self.first, self.start) = (first, only(started));
        }
        self.phase = EpisodePhase::Running;
        Ok(WorldStep {
            state: State::Running,
            observation: self.first.clone(),
            reward: 0.0,
            truncated: false,
            success: false,
            diverged: false,
        })
    }

    /// Advances the running episode by a step. If `interrupted`, the episode ends with this step.
    ///
    /// # Errors
    /// If the server has a defect.
    pub(super) async fn step(&mut self, actions: &[u8], interrupted: bool) -> Result<WorldStep, Error> {
        let StepResult { observations, rewards, terminated, truncated, ended, .. } = self.batch.step(actions).await?;
        let is_set = |flags: &Bytes| flags.first().is_some_and(|flag| *flag == 1);
        let truncated = is_set(&truncated);
        let state = state(is_set(&terminated), truncated || interrupted);
        if state != State::Running {
            self.phase = EpisodePhase::Over;
        }
        let end = ended.first().map(|(_, end)| end);
        Ok(WorldStep {
            state,
            observation: observations,
            reward: rewards.first_chunk().map_or(0.0, |word| f32::from_le_bytes(*word)),
            truncated,
            success: end.is_some_and(|end| end.success),
            diverged: end.is_some_and(|end| end.diverged),
        })
    }
}

/// Returns the protocol's state after a step. If the task ends an episode in the same step that interrupts it, the
/// episode counts as terminated, because no reward can follow its last state. In Gymnasium, too, learners do not
/// bootstrap from such a state.
fn state(terminated: bool, interrupted: bool) -> State {
    match (terminated, interrupted) {
        (true, _) => State::Terminated,
        (false, true) => State::Interrupted,
        (false, false) => State::Running,
    }
}

/// Returns the start of the only environment's episode, if an episode began.
fn only(started: Vec<(u32, StartedEpisode)>) -> Option<StartedEpisode> {
    started.into_iter().next().map(|(_, start)| start)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn end_by_task_and_step_limit_at_once_is_terminated() {
        assert_eq!(state(true, true), State::Terminated);
        assert_eq!(state(true, false), State::Terminated);
        assert_eq!(state(false, true), State::Interrupted);
        assert_eq!(state(false, false), State::Running);
    }
}
