//! Collects rollouts with actions chosen in this process.

use bytes::Bytes;

use super::Rollout;
use crate::client::{ClientError, EndedEpisode, Session, StepReply, StepSlice};
use perturb_policy::{CollectUntil, Player, PlayerState, RemainingRollout, SlotEnd};

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
    /// Whether collecting may succeed later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        matches!(self, Self::Client(error) if error.can_be_retried())
    }
}

/// Fills a rollout with the steps of a player: T steps of each of N environments, where episodes and a recurrent policy's
/// memory continue from one rollout to the next; or complete episodes.
///
/// Call [`Collector::begin`], then [`Collector::act`] and [`Collector::take`] by turns until [`Collector::is_done`], then
/// [`Collector::finish`].
#[derive(Debug)]
pub struct Collector {
    player: Player,
    remaining: RemainingRollout,
    /// Buffer for the ends of episodes in a step.
    ended: Vec<SlotEnd>,
}

/// The state of a training's environments and player, without statistics, for exact resumption.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectorState {
    /// `[N]` snapshots of the environments.
    pub snapshots: Vec<Bytes>,
    /// The player's state.
    pub player: PlayerState,
}

impl Collector {
    /// A collector of the steps of `player`.
    pub fn new(player: Player) -> Self {
        Self { player, remaining: RemainingRollout::Steps(0), ended: Vec::new() }
    }

    /// The player.
    pub fn player(&self) -> &Player {
        &self.player
    }

    /// The player, to be changed.
    pub fn player_mut(&mut self) -> &mut Player {
        &mut self.player
    }

    /// Begins a rollout with the weights that the player has loaded. For complete episodes `reset` ends the running
    /// episodes: it resets all environments and writes their observations `[N, O]`.
    ///
    /// # Errors
    /// [`CollectError`].
    pub fn begin(
        &mut self,
        until: CollectUntil,
        rollout: &mut Rollout,
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

    /// Whether nothing is left to collect.
    pub fn is_done(&self) -> bool {
        self.remaining.is_done()
    }

    /// Chooses the next actions, encoded for the protocol.
    ///
    /// # Errors
    /// [`CollectError::Numbers`].
    pub fn act(&mut self) -> Result<&[u8], CollectError> {
        Ok(self.player.act()?)
    }

    /// Appends the reply to the last actions. Passes the episodes that ended, and were to be collected, to `on_episode`.
    ///
    /// # Errors
    /// [`CollectError::Numbers`]; the steps of this rollout are lost.
    pub fn take(
        &mut self,
        reply: &StepSlice<'_>,
        rollout: &mut Rollout,
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

    /// Finishes the rollout.
    ///
    /// # Errors
    /// [`CollectError::Numbers`].
    pub fn finish(&mut self, rollout: &mut Rollout) -> Result<(), CollectError> {
        Ok(rollout.finish(self.player.last_values(&self.remaining)?)?)
    }

    /// Collects a whole rollout under the policy of `weights`, from a session with only this collector's environments.
    ///
    /// # Errors
    /// [`CollectError`]; the steps of this rollout are lost.
    pub fn collect(
        &mut self,
        session: &mut Session<'_>,
        weights: &[f32],
        until: CollectUntil,
        rollout: &mut Rollout,
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
