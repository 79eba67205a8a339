//! Trials of a policy in the environments of a session.

use std::collections::BTreeSet;
use std::ops::Range;

use perturb_policy::{Ended, Player, Result as PolicyResult};
use perturb_protocol::player::floats;

use super::error::TestError;
use crate::checkpoint::Checkpoint;
use crate::client::{EndedEpisode, Played, Session, StepReply, acting};
use crate::proto;

/// So many steps are asked for at a time: few beside those of a test, many beside the delay of a line.
const STEPS: u32 = 64;

/// A policy that plays trials, acting here.
pub(super) struct Trials<'a> {
    pub(super) session: Session<'a>,
    pub(super) player: Player,
    reply: StepReply,
    ended: Vec<Ended>,
}

/// One that plays them at the servers.
pub(super) struct RemoteTrials<'a> {
    session: Session<'a>,
    /// Until the servers have it: the policy, and its weights.
    policy: Option<(proto::Policy, bytes::Bytes)>,
    episodes_per_trial: u32,
}

impl<'a> Trials<'a> {
    /// `player` begins trials in the environments of `session`, which are observed as `observations` `[N, O]`.
    pub(super) fn begin(session: Session<'a>, mut player: Player, observations: &[f32]) -> PolicyResult<Self> {
        player.begin(observations, None)?;
        Ok(Self { session, player, reply: StepReply::default(), ended: Vec::new() })
    }

    /// A step in all environments; gives the episodes that ended a trial in it.
    pub(super) fn step(&mut self) -> Result<Vec<EndedEpisode>, TestError> {
        let Self { session, player, reply, ended } = self;
        session.step(player.act()?, reply)?;
        player.observe(&reply.all().outcome(ended), None)?;
        let episodes_per_trial = player.episodes_per_trial();
        Ok(reply.ended.drain(..).filter(|end| end.episode_in_trial + 1 == episodes_per_trial).collect())
    }
}

impl<'a> RemoteTrials<'a> {
    /// `player`, which plays the policy of `checkpoint`, begins trials in the environments of `session`.
    pub(super) fn new(session: Session<'a>, player: &Player, checkpoint: &Checkpoint) -> Self {
        let policy = (acting::policy(&checkpoint.policy, player), floats(&checkpoint.flat_weights()));
        Self { session, policy: Some(policy), episodes_per_trial: player.episodes_per_trial() }
    }

    /// Some steps in all environments; gives the episodes that ended a trial in them.
    pub(super) fn play(&mut self) -> Result<Vec<EndedEpisode>, TestError> {
        let (policy, episodes_per_trial) = (self.policy.take(), self.episodes_per_trial);
        let mut ended = Vec::new();
        let first = |slots: Range<usize>| proto::Act {
            policy: policy.as_ref().map(|(policy, _)| acting::for_server(policy, slots.len())),
            weights: policy.as_ref().map(|(_, weights)| weights.clone()).unwrap_or_default(),
            task: Some(proto::act::Task::Steps(STEPS)),
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

    /// A request to servers; notes the first slots of those that have not finished.
    fn play_part(
        &mut self,
        request: impl FnMut(Range<usize>) -> Option<proto::Act>,
        ended: &mut Vec<EndedEpisode>,
        unfinished: &mut BTreeSet<usize>,
    ) -> Result<(), TestError> {
        let take = |slots: Range<usize>, played: Played| {
            ended.extend(played.ended.into_iter().map(|(_, end)| end));
            if !played.acted.finished {
                unfinished.insert(slots.start);
            }
            Ok(())
        };
        Ok(self.session.play(request, take)?)
    }
}
