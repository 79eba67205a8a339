//! Plays test trials of a policy in the environments of a session.

use std::collections::BTreeSet;
use std::ops::Range;

use perturb_policy::{Player, Result as PolicyResult, SlotEnd};
use perturb_protocol::player::floats;

use super::error::TestError;
use crate::checkpoint::Checkpoint;
use crate::client::{ClientSession, EndedEpisode, RolloutReply, StepReply, acting};
use crate::proto;

/// Number of steps of each environment that a request asks a server to play. It is small compared with a whole test,
/// but large enough to hide network latency.
const STEPS_PER_REQUEST: u32 = 64;

/// Plays trials with actions that this process chooses.
pub(super) struct Trials<'a> {
    pub(super) session: ClientSession<'a>,
    pub(super) player: Player,
    reply: StepReply,
    ended: Vec<SlotEnd>,
}

/// Plays trials with actions that the servers choose.
pub(super) struct RemoteTrials<'a> {
    session: ClientSession<'a>,
    /// The `policy` message and the weights for the first request to the servers; `None` after this request.
    policy: Option<(proto::Policy, bytes::Bytes)>,
    episodes_per_trial: u32,
}

impl<'a> Trials<'a> {
    /// Starts trials of `player` in the environments of `session`. `observations` `[N, O]` are the environments' first
    /// observations.
    pub(super) fn begin(session: ClientSession<'a>, mut player: Player, observations: &[f32]) -> PolicyResult<Self> {
        player.begin(observations, None)?;
        Ok(Self { session, player, reply: StepReply::default(), ended: Vec::new() })
    }

    /// Steps all environments once. Returns the episodes that ended, if they are the last of their trial.
    pub(super) fn step(&mut self) -> Result<Vec<EndedEpisode>, TestError> {
        let Self { session, player, reply, ended } = self;
        session.step(player.act()?, reply)?;
        player.observe(&reply.all().outcome(ended), None)?;
        let episodes_per_trial = player.episodes_per_trial();
        Ok(reply.ended.drain(..).filter(|end| end.episode_in_trial + 1 == episodes_per_trial).collect())
    }
}

impl<'a> RemoteTrials<'a> {
    /// Prepares trials in the environments of `session`. `player` must have the policy of `checkpoint`.
    pub(super) fn new(session: ClientSession<'a>, player: &Player, checkpoint: &Checkpoint) -> Self {
        let policy = (acting::policy(&checkpoint.policy, player), floats(&checkpoint.flat_weights()));
        Self { session, policy: Some(policy), episodes_per_trial: player.episodes_per_trial() }
    }

    /// Steps all environments [`STEPS_PER_REQUEST`] times. Returns the episodes that ended, if they are the last of
    /// their trial.
    pub(super) fn play(&mut self) -> Result<Vec<EndedEpisode>, TestError> {
        let policy = self.policy.take();
        let episodes_per_trial = self.episodes_per_trial;
        let mut ended = Vec::new();
        let first = |slots: Range<usize>| proto::Act {
            policy: policy.as_ref().map(|(policy, _)| acting::for_server(policy, slots.len())),
            weights: policy.as_ref().map(|(_, weights)| weights.clone()).unwrap_or_default(),
            task: Some(proto::act::Task::Steps(STEPS_PER_REQUEST)),
            only_ended: true,
            ..proto::Act::default()
        };
        let mut unfinished = BTreeSet::new();
        self.play_part(|slots| Some(first(slots)), &mut ended, &mut unfinished)?;
        while !unfinished.is_empty() {
            let on = proto::Act { only_ended: true, ..proto::Act::default() };
            let asked = std::mem::take(&mut unfinished);
            let request = |slots: Range<usize>| asked.contains(&slots.start).then(|| on.clone());
            self.play_part(request, &mut ended, &mut unfinished)?;
        }
        ended.retain(|end: &EndedEpisode| end.episode_in_trial + 1 == episodes_per_trial);
        Ok(ended)
    }

    /// Sends a request to each server and receives the replies. Adds ended episodes to `ended`. If a server has not yet
    /// played all requested steps, adds its first slot to `unfinished`.
    fn play_part(
        &mut self,
        request: impl FnMut(Range<usize>) -> Option<proto::Act>,
        ended: &mut Vec<EndedEpisode>,
        unfinished: &mut BTreeSet<usize>,
    ) -> Result<(), TestError> {
        let take = |slots: Range<usize>, played: RolloutReply| {
            ended.extend(played.ended.into_iter().map(|(_, end)| end));
            if !played.acted.finished {
                unfinished.insert(slots.start);
            }
            Ok(())
        };
        Ok(self.session.play(request, take)?)
    }
}
