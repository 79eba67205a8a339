//! Replays recorded episodes and compares them with their records.

use std::collections::{BTreeMap, VecDeque};

use perturb_files::interrupt::StopFlag;
use perturb_protocol::Version;
use perturb_records::{EpisodeRecord, Records};
use perturb_settings::sets::Parameters;

use super::error::TestError;
use super::test::{retry_on_disconnect, with_disturbances};
use super::trials::Trials;
use crate::checkpoint::Checkpoint;
use crate::client::{ClientSession, OpenOptions, Servers};

/// The result of replaying recorded episodes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Audit {
    /// Number of replayed episodes.
    pub episodes: u64,
    /// A sentence for each replayed episode that differs from its record.
    pub different: Vec<String>,
}

/// The reason why recorded episodes could not be replayed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AuditError {
    /// The episodes were recorded with another policy.
    #[error(
        "the episodes were recorded with the policy {recorded}, the checkpoint is {got}: pass the checkpoint that was tested"
    )]
    Policy {
        /// The identifier of the recorded policy.
        recorded: String,
        /// The identifier of the checkpoint's policy.
        got: String,
    },
    /// Playing the episodes failed.
    #[error(transparent)]
    Test(#[from] TestError),
}

/// Replays at most `max_episodes` of the recorded episodes, evenly spread over all of them, and compares each with its
/// record. The replay uses only the episode's seed, environment index, episode index and requested parameters. Calls
/// `report` with the number of episodes done so far.
///
/// # Errors
/// [`AuditError`] if `checkpoint` is not the recorded policy, or if playing fails.
pub fn audit(
    servers: &Servers,
    checkpoint: &Checkpoint,
    records: &Records,
    max_episodes: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<Audit, AuditError> {
    let got = checkpoint.id().map_err(TestError::Unnamed)?;
    if got != records.about.policy {
        return Err(AuditError::Policy { recorded: records.about.policy.clone(), got });
    }
    Ok(retry_on_disconnect(servers, stop, || replay(servers, checkpoint, records, max_episodes, stop, report))?)
}

/// Replays the chosen episodes. An environment replays its recorded episodes one after another, while other
/// environments step too.
fn replay(
    servers: &Servers,
    checkpoint: &Checkpoint,
    records: &Records,
    max_episodes: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<Audit, TestError> {
    let mut queues: BTreeMap<usize, VecDeque<&EpisodeRecord>> = BTreeMap::new();
    // Queues the chosen episodes by the index of their environment.
    let chosen = spread(&records.episodes, max_episodes);
    for episode in chosen {
        queues.entry(episode.environment_index as usize).or_default().push_back(episode);
    }
    let Some(last) = queues.keys().next_back() else { return Ok(Audit::default()) };
    let mut replay = Replay::open(servers, checkpoint, records, last + 1)?;
    let mut audit = Audit::default();
    let mut running = BTreeMap::new();
    loop {
        // Begins the next episode in each environment that has none running.
        let idle: Vec<usize> = queues.keys().copied().filter(|slot| !running.contains_key(slot)).collect();
        for slot in idle {
            if let Some(episode) = queues.get_mut(&slot).and_then(VecDeque::pop_front) {
                replay.begin(slot, episode)?;
                running.insert(slot, episode);
            }
        }
        if running.is_empty() {
            return Ok(audit);
        }
        if let Some(signal) = stop.signal() {
            return Err(TestError::Stopped { signal });
        }
        // Compares each ended episode with its record.
        for end in replay.trials.step()? {
            let Some(recorded) = running.remove(&end.slot) else { continue };
            audit.episodes += 1;
            let got = EpisodeRecord::new(&records.about, &recorded.set, recorded.seed, end);
            audit.different.extend(recorded.difference(&got));
        }
        report(audit.episodes);
    }
}

/// Chooses at most `max_episodes` of `episodes`, evenly spread over all of them.
///
/// Divides `episodes` into nearly equal parts and takes one episode from each part: the first episode of the first
/// part, the second episode of the second part, and so on. After the last position in a part, the next part begins with
/// the first position again. The episodes of an environment are adjacent. Taking the first episode of every part could
/// therefore choose only the early episodes of each environment.
fn spread(episodes: &[EpisodeRecord], max_episodes: usize) -> impl Iterator<Item = &EpisodeRecord> {
    let count = max_episodes.min(episodes.len());
    (0..count).map(move |i| {
        let first = i * episodes.len() / count;
        let next = (i + 1) * episodes.len() / count;
        &episodes[first + i % (next - first)]
    })
}

/// The environments and the policy that replay recorded episodes.
struct Replay<'a> {
    trials: Trials<'a>,
    names: Vec<String>,
    episodes_per_trial: u64,
}

impl<'a> Replay<'a> {
    /// Opens `num_envs` environments with the recorded parameters.
    fn open(
        servers: &'a Servers,
        checkpoint: &'a Checkpoint,
        records: &Records,
        num_envs: usize,
    ) -> Result<Self, TestError> {
        let about = &records.about;
        let recorded = about.parameters.iter().map(|parameter| parameter.name.as_str());
        let environment = servers.environment(&about.environment)?.with_parameters(recorded).into_owned();
        let options = OpenOptions {
            environment: about.environment.clone(),
            version: Version::D,
            parameters: with_disturbances(Parameters::new(), &environment),
            contexts: Vec::new(),
            num_envs,
            seed: 0,
            episodes_per_trial: about.episodes_per_trial,
            observe: checkpoint.state.config.common.observe,
        };
        let mut observations = Vec::new();
        let session = ClientSession::open(servers, &options, &mut observations)?;
        checkpoint.state.check_unchanged(session.environment()).map_err(TestError::from)?;
        let player = checkpoint.player(num_envs, 0, 0)?;
        Ok(Self {
            trials: Trials::begin(session, player, &observations)?,
            names: about.parameters.iter().map(|parameter| parameter.name.clone()).collect(),
            episodes_per_trial: about.episodes_per_trial.into(),
        })
    }

    /// Starts the trial of `episode` in the environment of `slot`. The record is of the last episode of the trial, so
    /// the whole trial is replayed.
    fn begin(&mut self, slot: usize, episode: &EpisodeRecord) -> Result<(), TestError> {
        let Trials { session, player, .. } = &mut self.trials;
        let mut observation = vec![0.0; session.observation_size()];
        let values = self.names.iter().map(String::as_str).zip(episode.requested.iter().copied());
        session.reset_with(slot, &values.collect::<Vec<_>>(), episode.seed, &mut observation)?;
        let trial = episode.episode_index / self.episodes_per_trial;
        for _ in 0..trial * self.episodes_per_trial {
            session.reset_one(slot, &mut observation)?;
        }
        player.begin_trial(slot, episode.seed, trial);
        Ok(player.replace_observation(slot, &observation)?)
    }
}
