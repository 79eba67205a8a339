//! Players and what servers played, between the protocol and the domain.

use std::io::ErrorKind;
use std::ops::Range;

use perturb_policy::{Normalisers, Player, PlayerState, PolicySpec, Role};
use perturb_protocol::player::{Unreadable, doubles, observation_normaliser, player_state};
use perturb_protocol::{ClientError, EndedEpisode};

use super::part::Part;
use super::session::Session;
use crate::proto;

/// Steps that one server played in all its environments, with the episodes that ended in them.
#[derive(Clone, Debug, Default)]
pub struct Played {
    /// As the protocol has them, `[T, N, …]`.
    pub acted: proto::Acted,
    /// In order of steps and slots, with the steps, 0 … T-1.
    pub ended: Vec<(usize, EndedEpisode)>,
}

impl Session<'_> {
    /// Has servers play: `request` makes what each is asked for, if anything, of its slots, and `take` gets these and each
    /// one's reply. They compute at the same time.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's sentence; [`ClientError::Protocol`] if the reply does not fit; the
    /// failures of a connection.
    pub fn play(
        &mut self,
        mut request: impl FnMut(Range<usize>) -> Option<proto::Act>,
        mut take: impl FnMut(Range<usize>, Played) -> Result<(), String>,
    ) -> Result<(), ClientError> {
        self.exchange(
            |part| request(part.range.clone()),
            |part, acted: proto::Acted| {
                let played = part.played(acted)?;
                take(part.range.clone(), played).map_err(|got| part.misplayed(got))
            },
        )
    }

    /// Asks the one server of a batch that is [played as a whole](Session::plays_together) to play, without waiting for its
    /// reply, which [`Session::played`] takes.
    ///
    /// # Errors
    /// The failures of a connection.
    pub fn ask_to_play(&mut self, act: proto::Act) -> Result<(), ClientError> {
        let Self { servers, parts, .. } = self;
        let [part] = parts.as_mut_slice() else { return Err(not_played_together()) };
        let sent = servers.block_on(async {
            part.stream.send(act).await?;
            // What drives the connection has its turn before the caller computes for long.
            tokio::task::yield_now().await;
            Ok(())
        });
        sent.map_err(|error| servers.explain(error))
    }

    /// The reply to [`Session::ask_to_play`], when it comes.
    ///
    /// # Errors
    /// Those of [`Session::play`].
    pub async fn played(&mut self) -> Result<Played, ClientError> {
        let Self { servers, parts, .. } = self;
        let [part] = parts.as_mut_slice() else { return Err(not_played_together()) };
        let acted = part.stream.receive::<proto::Act>().await.map_err(|error| servers.explain(error))?;
        part.played(acted)
    }

    /// The error for a reply to [`Session::played`] that does not fit.
    pub fn misplayed(&self, got: String) -> ClientError {
        self.parts.first().map_or_else(not_played_together, |part| part.misplayed(got))
    }

    /// What stands beside the weights of the policy that a server plays; `None` if the batch is not on one server.
    ///
    /// # Errors
    /// Those of [`Session::play`].
    pub fn save_player(&mut self) -> Result<Option<(PlayerState, Normalisers)>, ClientError> {
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

fn not_played_together() -> ClientError {
    ClientError::System { action: "play a batch of several servers as a whole", source: ErrorKind::Unsupported.into() }
}

impl Part {
    fn misplayed(&self, got: String) -> ClientError {
        self.stream.mismatch::<proto::Act>(got, "arrays as the protocol describes them".into())
    }

    /// Names the episodes that ended in a reply.
    fn played(&self, mut acted: proto::Acted) -> Result<Played, ClientError> {
        let mut ended = Vec::with_capacity(acted.ended.len());
        for proto::EndedAt { step, end, terminated, .. } in std::mem::take(&mut acted.ended) {
            let slot = end.as_ref().map_or(usize::MAX, |end| self.range.start.saturating_add(end.slot as usize));
            let inside = self.range.contains(&slot) && step < acted.steps;
            let episode = end.filter(|_| inside).and_then(|end| EndedEpisode::of(end, slot, terminated));
            let Some(episode) = episode else {
                let got = format!("an ended episode of slot {slot} in step {step}");
                let expected = "a named episode with its receipt".into();
                return Err(self.stream.mismatch::<proto::Act>(got, expected));
            };
            ended.push((step as usize, episode));
        }
        Ok(Played { acted, ended })
    }
}

/// A player as the protocol has it, to begin where it is.
pub fn policy(spec: &PolicySpec, player: &Player) -> proto::Policy {
    let Normalisers { observations, rewards } = player.normalisers();
    proto::Policy {
        hidden: spec.hidden.iter().map(|&width| width as u32).collect(),
        lstm: spec.lstm.map_or(0, |width| width as u32),
        outcomes: spec.observation_size > player.observation_size(),
        observations: observations.as_ref().map(|it| it.moments().into()),
        rewards: rewards.as_ref().map(Into::into),
        role: Some(match player.role() {
            Role::Training(stream) => proto::policy::Role::Training(stream.into()),
            Role::Testing(trials) => proto::policy::Role::Testing(proto::TestStreams { seed: trials.seed() }),
        }),
        state: player.state().as_ref().map(Into::into),
    }
}

/// The policy of a test, for one of several servers that has `n_envs` environments.
pub fn for_server(policy: &proto::Policy, n_envs: usize) -> proto::Policy {
    let mut policy = policy.clone();
    if let Some(rewards) = &mut policy.rewards {
        rewards.returns = doubles(&vec![0.0; n_envs]); // of no use where statistics are frozen
    }
    policy
}

/// What is wrong if it is none. `observation_size` is that of the session, O, of which statistics may leave the end
/// alone.
fn saved_player(saved: &proto::PlayerSaved, observation_size: usize) -> Result<(PlayerState, Normalisers), String> {
    let (Some(actions), Some(state)) = (&saved.actions, &saved.state) else {
        return Err("state or stream of actions is missing".into());
    };
    let of = |field: &'static str| move |wrong: Unreadable| wrong.within(field).to_string();
    let normaliser = |moments| observation_normaliser(moments, observation_size);
    let observations = saved.observations.as_ref().map(normaliser).transpose().map_err(of("observations"))?;
    let rewards = saved.rewards.as_ref().map(TryInto::try_into).transpose().map_err(of("rewards"))?;
    let actions = actions.try_into().map_err(of("actions"))?;
    Ok((player_state(state, actions).map_err(of("state"))?, Normalisers { observations, rewards }))
}
