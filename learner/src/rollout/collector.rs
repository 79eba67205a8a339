//! Collects rollouts whose actions are chosen in this process.

use bytes::Bytes;

use super::RolloutBuffer;
use crate::client::{ClientError, ClientSession, EndedEpisode, StepReply, StepSlice};
use perturb_policy::{CollectUntil, Player, PlayerTrainingState, RemainingRollout, SlotEnd};

/// The reason why a rollout could not be collected.
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
    /// Returns whether collecting may succeed later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        matches!(self, Self::Client(error) if error.can_be_retried())
    }
}

/// Fills rollouts with the steps of a player in N environments.
///
/// A rollout has either T steps of each environment, or complete episodes. If it has T steps, an unfinished episode
/// continues in the next rollout, and a recurrent policy keeps its memory.
///
/// For each rollout, call [`Collector::begin`], then alternate [`Collector::act`] and [`Collector::take`] until
/// [`Collector::is_done`] returns true, then call [`Collector::finish`].
#[derive(Debug)]
pub struct Collector {
    player: Player,
    remaining: RemainingRollout,
    /// Buffer for the episodes that end in a step.
    ended: Vec<SlotEnd>,
}

/// The state of a training's environments and of its player, from which it resumes exactly. It does not contain the
/// normalisers, which the checkpoint stores separately.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectorState {
    /// Snapshots of the N environments.
    pub snapshots: Vec<Bytes>,
    /// The player's state.
    pub player: PlayerTrainingState,
}

impl Collector {
    /// Returns a collector for the steps of `player`.
    pub fn new(player: Player) -> Self {
        Self { player, remaining: RemainingRollout::Steps(0), ended: Vec::new() }
    }

    /// Returns the player.
    pub fn player(&self) -> &Player {
        &self.player
    }

    /// Returns the player mutably.
    pub fn player_mut(&mut self) -> &mut Player {
        &mut self.player
    }

    /// Starts a rollout with the weights that the player has loaded. `until` is the amount to collect. For complete
    /// episodes, `reset` is called: it must reset all environments, and write their first observations `[N, O]`.
    ///
    /// # Errors
    /// [`CollectError`] if the reset fails or an observation is not finite.
    pub fn begin(
        &mut self,
        until: CollectUntil,
        rollout: &mut RolloutBuffer,
        reset: impl FnOnce(&mut [f32]) -> Result<(), ClientError>,
    ) -> Result<(), CollectError> {
        self.remaining = until.begin(self.player.n_envs());
        if let CollectUntil::Episodes(_) = until {
            let mut observations = vec![0.0; self.player.n_envs() * self.player.observation_size()];
            reset(&mut observations)?;
            self.player.begin(&observations, Some(&self.remaining))?;
        }
        rollout.begin(self.player.memory());
        Ok(())
    }

    /// Returns whether the rollout has all its steps or complete episodes.
    pub fn is_done(&self) -> bool {
        self.remaining.is_done()
    }

    /// Chooses the next actions, and returns them in the protocol's encoding.
    ///
    /// # Errors
    /// [`CollectError::Numbers`] if the policy's output is not finite.
    pub fn act(&mut self) -> Result<&[u8], CollectError> {
        Ok(self.player.act()?)
    }

    /// Appends a step to the rollout: the last actions with the environments' `reply`. Calls `on_episode` for each
    /// ended episode that belongs to the rollout.
    ///
    /// # Errors
    /// [`CollectError::Numbers`] if a number is not finite; the steps of this rollout are then lost.
    pub fn take(
        &mut self,
        reply: &StepSlice<'_>,
        rollout: &mut RolloutBuffer,
        mut on_episode: impl FnMut(&EndedEpisode),
    ) -> Result<(), CollectError> {
        let Self { player, remaining, ended } = self;
        let outcome = reply.outcome(ended);
        remaining.advance(outcome.ended.iter().map(|end| end.slot));
        player.observe(&outcome, Some(remaining))?;
        rollout.push(player.played())?;
        for (end, episode) in outcome.ended.iter().zip(reply.ended).filter(|(end, _)| remaining.counts(end.slot)) {
            if let RemainingRollout::Episodes(_) = remaining {
                rollout.note_episode(end.slot, rollout.len(), episode.length as usize, episode.episode_return)?;
            }
            on_episode(episode);
        }
        Ok(())
    }

    /// Finishes the rollout: computes and stores the values of the observations after the last step.
    ///
    /// # Errors
    /// [`CollectError::Numbers`] if a value is not finite.
    pub fn finish(&mut self, rollout: &mut RolloutBuffer) -> Result<(), CollectError> {
        Ok(rollout.finish(self.player.last_values(&self.remaining)?)?)
    }

    /// Collects a complete rollout with the policy `weights`, in a session that has only this collector's environments.
    ///
    /// # Errors
    /// [`CollectError`] if the session fails or a number is not finite; the steps of this rollout are then lost.
    pub fn collect(
        &mut self,
        session: &mut ClientSession<'_>,
        weights: &[f32],
        until: CollectUntil,
        rollout: &mut RolloutBuffer,
        mut on_episode: impl FnMut(&EndedEpisode),
    ) -> Result<(), CollectError> {
        let mut reply = StepReply::default();
        self.player.load(weights)?;
        self.begin(until, rollout, |observations| session.reset(0..session.num_envs(), observations))?;
        while !self.is_done() {
            session.step(self.act()?, &mut reply)?;
            self.take(&reply.all(), rollout, &mut on_episode)?;
        }
        self.finish(rollout)
    }
}
