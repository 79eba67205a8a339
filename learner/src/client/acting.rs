//! Lets servers play a policy: they choose the actions themselves and return whole rollouts.

use std::io::ErrorKind;
use std::ops::Range;

use perturb_policy::{Normalisers, Player, PlayerRole, PlayerTrainingState, PolicySpec};
use perturb_protocol::player::{DecodeError, doubles, observation_normaliser, player_state};
use perturb_protocol::{ClientError, EndedEpisode};

use super::session::ClientSession;
use super::shard::ServerShard;
use crate::proto;

/// A server's reply with the T steps that it played in each of its N environments, and the episodes that ended in these
/// steps.
#[derive(Clone, Debug, Default)]
pub struct RolloutReply {
    /// The steps in the protocol's encoding, as arrays `[T, N, …]`.
    pub acted: proto::Acted,
    /// The ended episodes, each with the index of its last step (0 … T-1), ordered by step, then by slot.
    pub ended: Vec<(usize, EndedEpisode)>,
}

impl ClientSession<'_> {
    /// Lets all servers of the session play at the same time. `request` returns the request for a server's range of
    /// slots, or `None` to skip this server. `take` receives the range and the server's reply. An error of `take` says
    /// what is wrong with the reply.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's message, [`ClientError::Protocol`] for a malformed reply, and
    /// connection failures.
    pub fn play(
        &mut self,
        mut request: impl FnMut(Range<usize>) -> Option<proto::Act>,
        mut take: impl FnMut(Range<usize>, RolloutReply) -> Result<(), String>,
    ) -> Result<(), ClientError> {
        self.exchange(
            |part| request(part.range.clone()),
            |part, acted: proto::Acted| {
                let played = part.played(acted)?;
                take(part.range.clone(), played).map_err(|got| part.malformed_rollout(got))
            },
        )
    }

    /// Asks the only server of the session to play, and returns without waiting for the reply.
    /// [`ClientSession::played`] receives the reply. Must be called only if [`ClientSession::plays_together`] is true.
    ///
    /// # Errors
    /// Connection failures, and [`ClientError::System`] if the session has several servers.
    pub fn ask_to_play(&mut self, act: proto::Act) -> Result<(), ClientError> {
        let Self { servers, parts, .. } = self;
        let [part] = parts.as_mut_slice() else { return Err(not_played_together()) };
        servers.wait_for(async {
            part.stream.send(act).await?;
            // Lets the task that drives the connection send the request before the caller computes for a long time.
            tokio::task::yield_now().await;
            Ok(())
        })
    }

    /// Receives the reply to [`ClientSession::ask_to_play`].
    ///
    /// # Errors
    /// The errors of [`ClientSession::play`].
    pub async fn played(&mut self) -> Result<RolloutReply, ClientError> {
        let Self { servers, parts, .. } = self;
        let [part] = parts.as_mut_slice() else { return Err(not_played_together()) };
        let acted = part.stream.receive::<proto::Act>().await.map_err(|error| servers.explain(error))?;
        part.played(acted)
    }

    /// Returns the error for a malformed reply that [`ClientSession::played`] received. `got` says what is wrong.
    pub fn malformed_rollout(&self, got: String) -> ClientError {
        self.parts.first().map_or_else(not_played_together, |part| part.malformed_rollout(got))
    }

    /// Asks the server for its player's state and normalisers. Returns `None` if the session is spread over several
    /// servers.
    ///
    /// # Errors
    /// The errors of [`ClientSession::play`].
    pub fn save_player(&mut self) -> Result<Option<(PlayerTrainingState, Normalisers)>, ClientError> {
        let size = self.observation_size();
        let mut states = Vec::new();
        self.exchange(
            |_| Some(proto::SavePlayer {}),
            |part, saved: proto::PlayerSaved| {
                let mismatch = |got| {
                    let expected = "what a later policy goes on from";
                    part.stream.mismatch::<proto::SavePlayer>(format!("a player whose {got}"), expected.into())
                };
                states.push(saved_player(&saved, size).map_err(mismatch)?);
                Ok(())
            },
        )?;
        Ok(states.pop().filter(|_| states.is_empty()))
    }
}

/// Returns the error of a call that needs a session with one server.
fn not_played_together() -> ClientError {
    ClientError::System { action: "play a batch of several servers as a whole", source: ErrorKind::Unsupported.into() }
}

impl ServerShard {
    fn malformed_rollout(&self, got: String) -> ClientError {
        self.stream.mismatch::<proto::Act>(got, "arrays as the protocol describes them".into())
    }

    /// Converts this server's reply. In the ended episodes, slot numbers of the server become slot numbers of the whole
    /// batch.
    fn played(&self, mut acted: proto::Acted) -> Result<RolloutReply, ClientError> {
        let mut ended = Vec::with_capacity(acted.ended.len());
        for proto::EndedAt { step, end, terminated, .. } in std::mem::take(&mut acted.ended) {
            let slot = end.as_ref().map_or(usize::MAX, |end| self.range.start.saturating_add(end.slot as usize));
            let inside = self.range.contains(&slot) && step < acted.steps;
            let episode = end.filter(|_| inside).and_then(|end| EndedEpisode::from_proto(end, slot, terminated));
            let Some(episode) = episode else {
                let got = format!("an ended episode of slot {slot} in step {step}");
                let expected = "a named episode with its receipt".into();
                return Err(self.stream.mismatch::<proto::Act>(got, expected));
            };
            ended.push((step as usize, episode));
        }
        Ok(RolloutReply { acted, ended })
    }
}

/// Returns the message that lets a server continue from the state of `player`: shape of the policy, normalisers, random
/// streams, observations and memory. It has no weights.
pub fn policy(spec: &PolicySpec, player: &Player) -> proto::Policy {
    let Normalisers { observations, rewards } = player.normalisers();
    proto::Policy {
        hidden: spec.hidden.iter().map(|&width| width as u32).collect(),
        lstm: spec.lstm.map_or(0, |width| width as u32),
        outcomes: spec.observation_size > player.observation_size(),
        observations: observations.as_ref().map(|it| it.moments().into()),
        rewards: rewards.as_ref().map(Into::into),
        role: Some(match player.role() {
            PlayerRole::Training(stream) => proto::policy::Role::Training(stream.into()),
            PlayerRole::Testing(trials) => proto::policy::Role::Testing(proto::TestStreams { seed: trials.seed() }),
        }),
        state: player.state().as_ref().map(Into::into),
    }
}

/// Adapts the `policy` message of a test to one of several servers, on which `n_envs` of the batch's environments are.
pub fn for_server(policy: &proto::Policy, n_envs: usize) -> proto::Policy {
    let mut policy = policy.clone();
    if let Some(rewards) = &mut policy.rewards {
        rewards.returns = doubles(&vec![0.0; n_envs]); // a test does not update statistics, so these zeros are never used
    }
    policy
}

/// Parses the state of a server's player. `observation_size` is the session's O. If the normaliser has fewer than O
/// entries, the last entries of observations are not normalised. The error names the invalid field.
fn saved_player(
    saved: &proto::PlayerSaved,
    observation_size: usize,
) -> Result<(PlayerTrainingState, Normalisers), String> {
    let (Some(actions), Some(state)) = (&saved.actions, &saved.state) else {
        return Err("state or stream of actions is missing".into());
    };
    let of = |field: &'static str| move |wrong: DecodeError| wrong.within(field).to_string();
    let normaliser = |moments| observation_normaliser(moments, observation_size);
    let observations = saved.observations.as_ref().map(normaliser).transpose().map_err(of("observations"))?;
    let rewards = saved.rewards.as_ref().map(TryInto::try_into).transpose().map_err(of("rewards"))?;
    let actions = actions.try_into().map_err(of("actions"))?;
    Ok((player_state(state, actions).map_err(of("state"))?, Normalisers { observations, rewards }))
}
