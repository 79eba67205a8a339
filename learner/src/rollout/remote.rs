//! Collecting rollouts that a server plays.

use super::{CollectError, Rollout};
use crate::client::{EndedEpisode, Played, Session, acting};
use crate::proto;
use perturb_policy::{ActionKind, CollectUntil, Normalisers, Player, PlayerState, PolicySpec, RolloutStep};
use perturb_protocol::player::{floats, read_floats};

/// Fills rollouts with what a player does that plays at the server, to the bytes of a
/// [`Collector`](super::Collector).
///
/// [`RemoteCollector::begin`] says what to ask the server for, [`RemoteCollector::take`] takes the reply and says what to
/// ask for next, until nothing is left.
#[derive(Debug)]
pub struct RemoteCollector {
    spec: PolicySpec,
    /// Until the server has it.
    player: Option<Player>,
    until: CollectUntil,
    /// Of a reply; 0 leaves it to the server.
    most_steps: u32,
    /// The next reply is the rollout's first.
    begins: bool,
    arrays: Arrays,
}

/// A reply's arrays, decoded.
#[derive(Debug, Default)]
struct Arrays {
    observations: Vec<f32>,
    starts: Vec<bool>,
    actions: Vec<f32>,
    log_probs: Vec<f32>,
    values: Vec<f32>,
    rewards: Vec<f32>,
    terminated: Vec<bool>,
    truncated: Vec<bool>,
    truncation_values: Vec<f32>,
    last: Vec<f32>,
}

impl RemoteCollector {
    /// Collects what `player` does from where it is, with a policy of `spec`.
    pub fn new(spec: PolicySpec, player: Player) -> Self {
        let (until, arrays) = (CollectUntil::Steps(0), Arrays::default());
        Self { spec, player: Some(player), until, most_steps: 0, begins: true, arrays }
    }

    /// The same with replies of about so many environment steps at most, where others wait for the server too.
    pub fn in_pieces(self, env_steps: usize) -> Self {
        let n_envs = self.player.as_ref().map_or(1, Player::n_envs);
        Self { most_steps: (env_steps / n_envs).max(1) as u32, ..self }
    }

    /// The request that begins a rollout under the policy of `weights`.
    pub fn begin(&mut self, weights: &[f32], until: CollectUntil) -> proto::Act {
        (self.until, self.begins) = (until, true);
        proto::Act {
            policy: self.player.take().map(|player| acting::policy(&self.spec, &player)),
            weights: floats(weights),
            task: Some(until.into()),
            most_steps: self.most_steps,
            ..proto::Act::default()
        }
    }

    /// Takes what `session` played; gives every episode that ended, and was to be collected, to `on_episode`. The request
    /// for what is left of the rollout, `None` when it is finished.
    ///
    /// # Errors
    /// [`CollectError`]; what was collected of this rollout is lost.
    pub fn take(
        &mut self,
        session: &Session<'_>,
        played: &Played,
        rollout: &mut Rollout,
        mut on_episode: impl FnMut(&EndedEpisode),
    ) -> Result<Option<proto::Act>, CollectError> {
        let Self { spec, until, most_steps, begins, arrays, .. } = self;
        let mismatch = |got| session.misplayed(got);
        if std::mem::take(begins) {
            let memory = read_floats("memory", &played.acted.memory);
            rollout.begin(&memory.map_err(|wrong| mismatch(wrong.to_string()))?);
        }
        arrays.decode(&played.acted, spec).map_err(mismatch)?;
        let before = rollout.len();
        rollout.push(arrays.steps())?;
        for (step, episode) in &played.ended {
            if let CollectUntil::Episodes(_) = until {
                let (end, length) = (before + step + 1, episode.length as usize);
                rollout.note_episode(episode.slot, end, length, episode.episode_return)?;
            }
            on_episode(episode);
        }
        if played.acted.finished {
            rollout.finish(&arrays.last)?;
            return Ok(None);
        }
        Ok(Some(proto::Act { most_steps: *most_steps, ..proto::Act::default() }))
    }

    /// What stands beside the weights after a rollout; `None` before the first.
    ///
    /// # Errors
    /// [`CollectError::Client`].
    pub fn state(&self, session: &mut Session<'_>) -> Result<Option<(PlayerState, Normalisers)>, CollectError> {
        if self.player.is_some() { Ok(None) } else { Ok(session.save_player()?) }
    }
}

impl Arrays {
    /// Replaces all by those of a reply; says which does not fit.
    fn decode(&mut self, acted: &proto::Acted, spec: &PolicySpec) -> Result<(), String> {
        read(&mut self.observations, "observations", &acted.observations, f32::from_le_bytes)?;
        if let ActionKind::Discrete { n } = spec.action {
            read(&mut self.actions, "actions", &acted.actions, |word| i32::from_le_bytes(word) as f32)?;
            if let Some(action) = self.actions.iter().find(|&&action| !(0.0..n as f32).contains(&action)) {
                return Err(format!("action {action} of {n}"));
            }
        } else {
            read(&mut self.actions, "actions", &acted.actions, f32::from_le_bytes)?;
        }
        read(&mut self.log_probs, "log_probs", &acted.log_probs, f32::from_le_bytes)?;
        read(&mut self.values, "values", &acted.values, f32::from_le_bytes)?;
        read(&mut self.rewards, "rewards", &acted.rewards, f32::from_le_bytes)?;
        read(&mut self.truncation_values, "truncation_values", &acted.truncation_values, f32::from_le_bytes)?;
        read(&mut self.last, "last_values", &acted.last_values, f32::from_le_bytes)?;
        flags(&mut self.starts, &acted.starts);
        flags(&mut self.terminated, &acted.terminated);
        flags(&mut self.truncated, &acted.truncated);
        Ok(())
    }

    fn steps(&self) -> RolloutStep<'_> {
        RolloutStep {
            observations: &self.observations,
            starts: &self.starts,
            actions: &self.actions,
            log_probs: &self.log_probs,
            values: &self.values,
            rewards: &self.rewards,
            terminated: &self.terminated,
            truncated: &self.truncated,
            truncation_values: &self.truncation_values,
        }
    }
}

fn read(out: &mut Vec<f32>, name: &str, bytes: &[u8], number: impl Fn([u8; 4]) -> f32) -> Result<(), String> {
    let (words, rest) = bytes.as_chunks::<4>();
    out.clear();
    out.extend(words.iter().map(|word| number(*word)));
    if rest.is_empty() { Ok(()) } else { Err(format!("{} bytes of {name}", bytes.len())) }
}

fn flags(out: &mut Vec<bool>, bytes: &[u8]) {
    out.clear();
    out.extend(bytes.iter().map(|&flag| flag != 0));
}
