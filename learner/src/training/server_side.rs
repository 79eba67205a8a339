//! Collects rollouts that the server plays. Each run has a separate session, and this process receives complete
//! rollouts.
//!
//! While one run is updated, the server plays the rollouts of the others. Runs share only this thread and the gradient
//! workspace. So each run gives the same bytes as if it were trained alone.

use std::pin::Pin;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use perturb_policy::{CollectUntil, Normalisers, Player, PlayerTrainingState, PolicySpec};
use perturb_protocol::player::{floats, read_floats};
use perturb_settings::CollectionMode;

use super::start::{options, start_or_resume};
use super::trainer::Trainer;
use super::{CollectRollouts, Collected, Result, Run, TrainOutcome, TrainRequest};
use crate::client::{ClientError, ClientSession, RolloutReply, Servers, acting};
use crate::proto;
use crate::rollout::{CollectError, DecodedRollout};

/// Maximum number of environment steps in one reply if several runs use the server. The server plays this many steps in
/// some milliseconds in a classic task, and in a tenth of a second with a robot. So no run waits long for the server.
const PIECE_ENV_STEPS: usize = 4096;

/// A future that receives a reply, and returns it with the run's session.
type PendingReply<'a> =
    Pin<Box<dyn Future<Output = (Box<ServerLane<'a>>, std::result::Result<RolloutReply, ClientError>)> + 'a>>;

/// Collects the rollouts of runs whose actions the server chooses.
pub(super) struct ServerSide<'a> {
    servers: &'a Servers,
    /// Runs between two rollouts, for which the server is not playing.
    #[expect(clippy::vec_box, reason = "a lane moves into its pending reply and back, as a pointer")]
    idle: Vec<Box<ServerLane<'a>>>,
    /// Runs for which the server is playing a rollout.
    playing: FuturesUnordered<PendingReply<'a>>,
    /// Total time that this thread has waited because no run had a complete rollout.
    waited: Duration,
}

/// The session and the state of a run.
struct ServerLane<'a> {
    /// The index of the run.
    index: usize,
    session: ClientSession<'a>,
    spec: PolicySpec,
    /// The initial player, until the first request has sent its state to the server.
    player: Option<Player>,
    /// Maximum number of steps in one reply; 0 lets the server decide.
    max_steps: u32,
    /// Whether the next reply is the first one of its rollout.
    begins: bool,
    decoded: DecodedRollout,
    /// The value of [`ServerSide::waited`] when the rollout was requested.
    waited: Duration,
}

impl<'a> ServerSide<'a> {
    /// Opens a session for each of `entries` whose policy the server can play, and starts or resumes its run. Returns
    /// these runs, and the other entries, whose actions must be chosen in this process. These are entries with
    /// observation noise, entries with several servers and, if there is more than one entry, entries with short
    /// rollouts. If a run cannot start, calls `ended` with its index and the error.
    ///
    /// # Errors
    /// An error if a session cannot be opened.
    #[allow(clippy::type_complexity)] // both list types are used only here
    pub(super) fn open<'d>(
        servers: &'a Servers,
        entries: Vec<(usize, TrainRequest<'d>)>,
        threads: usize,
        ended: &mut dyn FnMut(usize, Result<TrainOutcome>),
    ) -> Result<(Self, Vec<Run<'d>>, Vec<(usize, TrainRequest<'d>)>)> {
        let is_one = entries.len() == 1;
        let mut idle = Vec::new();
        let mut runs = Vec::new();
        let mut others = Vec::new();
        for (index, entry) in entries {
            let config = entry.start.config();
            let rollouts = config.rollouts();
            // The learner chooses the actions where it adds observation noise, and where several trainings with short
            // rollouts share each message.
            if rollouts == CollectionMode::Noisy || (!is_one && rollouts != CollectionMode::Long) {
                others.push((index, entry));
                continue;
            }
            let mut observations = Vec::new();
            let mut session = ClientSession::open(servers, &options(config), &mut observations)?;
            // A server chooses actions only if it has all environments of the training.
            if !session.plays_together() {
                others.push((index, entry));
                continue;
            }
            let n_envs = session.num_envs();
            match start_or_resume(entry, &mut session, 0..n_envs, &observations, threads) {
                Ok((trainer, player)) => {
                    idle.push(Box::new(ServerLane {
                        index,
                        session,
                        spec: trainer.spec().clone(),
                        player: Some(player),
                        max_steps: if is_one { 0 } else { (PIECE_ENV_STEPS / n_envs).max(1) as u32 },
                        begins: true,
                        decoded: DecodedRollout::default(),
                        waited: Duration::ZERO,
                    }));
                    runs.push(Run { index, trainer, end: None });
                }
                Err(error) => ended(index, Err(error)),
            }
        }
        let server_side = Self { servers, idle, playing: FuturesUnordered::new(), waited: Duration::ZERO };
        Ok((server_side, runs, others))
    }

    /// Returns the idle lane of the run with this index.
    fn lane(&mut self, index: usize) -> Option<&mut ServerLane<'a>> {
        self.idle.iter_mut().map(Box::as_mut).find(|lane| lane.index == index)
    }
}

impl CollectRollouts for ServerSide<'_> {
    fn collect(&mut self, runs: &mut [Run<'_>]) -> Result<Vec<Collected>> {
        for mut lane in std::mem::take(&mut self.idle) {
            let Some(run) = super::find(runs, lane.index) else { continue };
            let asked = lane.request_rollout(&run.trainer, self.waited);
            if run.store_error(asked, false)?.is_some() {
                self.playing.push(Box::pin(lane.played()));
            }
        }
        while runs.iter().all(|run| run.end.is_none()) {
            let start = Instant::now();
            let next = self.servers.wait_for(async { Ok(self.playing.next().await) });
            let Some((mut lane, played)) = next? else { break };
            self.waited += start.elapsed();
            let Some(run) = super::find(runs, lane.index) else { continue };
            let is_whole = lane.take(played, &mut run.trainer);
            match run.store_error(is_whole, false)? {
                None => {}
                Some(false) => self.playing.push(Box::pin(lane.played())),
                Some(true) => {
                    let waiting = self.waited - lane.waited;
                    let collected = Collected { index: lane.index, acting: Duration::ZERO, waiting };
                    self.idle.push(lane);
                    return Ok(vec![collected]);
                }
            }
        }
        Ok(Vec::new())
    }

    fn player(&mut self, _: usize) -> Option<&mut Player> {
        None
    }

    fn player_state(&mut self, index: usize) -> Result<Option<(PlayerTrainingState, Normalisers)>> {
        let Some(lane) = self.lane(index).filter(|lane| lane.player.is_none()) else { return Ok(None) };
        Ok(lane.session.save_player()?)
    }

    fn snapshots(&mut self, index: usize) -> Result<Vec<Bytes>> {
        let Some(lane) = self.lane(index) else { return Ok(Vec::new()) };
        Ok(lane.session.snapshot(0..lane.session.num_envs())?)
    }

    fn release(&mut self, index: usize) -> Result<()> {
        self.idle.retain(|lane| lane.index != index);
        Ok(())
    }

    fn is_shared(&self) -> bool {
        false
    }
}

impl<'a> ServerLane<'a> {
    /// Requests a rollout of the trainer's current policy from the server.
    fn request_rollout(&mut self, trainer: &Trainer<'_>, waited: Duration) -> Result<()> {
        (self.begins, self.waited) = (true, waited);
        let act = proto::Act {
            policy: self.player.take().map(|player| acting::policy(&self.spec, &player)),
            weights: floats(trainer.weights()),
            task: Some(trainer.collect_until().into()),
            most_steps: self.max_steps,
            ..proto::Act::default()
        };
        Ok(self.session.ask_to_play(act)?)
    }

    /// Receives the reply. Takes the lane by value, because the future must own it.
    async fn played(mut self: Box<Self>) -> (Box<Self>, std::result::Result<RolloutReply, ClientError>) {
        let played = self.session.played().await;
        (self, played)
    }

    /// Appends the steps of a reply to the rollout. Returns whether the rollout is complete. If not, requests the
    /// remaining steps.
    ///
    /// # Errors
    /// An error for a malformed reply or a connection failure. The steps of this rollout are then lost.
    fn take(
        &mut self,
        played: std::result::Result<RolloutReply, ClientError>,
        trainer: &mut Trainer<'_>,
    ) -> Result<bool> {
        let Self { session, spec, max_steps, begins, decoded, .. } = self;
        let RolloutReply { acted, ended } = played?;
        let until = trainer.collect_until();
        let (rollout, tally) = trainer.collecting();
        let mismatch = |got| CollectError::Client(session.malformed_rollout(got));
        if std::mem::take(begins) {
            let memory = read_floats("memory", &acted.memory);
            rollout.begin(&memory.map_err(|wrong| mismatch(wrong.to_string()))?);
        }
        decoded.decode(&acted, spec).map_err(mismatch)?;
        let before = rollout.len();
        rollout.push(decoded.steps())?;
        for (step, episode) in &ended {
            if let CollectUntil::Episodes(_) = until {
                let end = before + step + 1;
                let length = episode.length as usize;
                rollout.note_episode(episode.slot, end, length, episode.episode_return)?;
            }
            tally.note(episode);
        }
        if acted.finished {
            rollout.finish(decoded.last_values())?;
            return Ok(true);
        }
        session.ask_to_play(proto::Act { most_steps: *max_steps, ..proto::Act::default() })?;
        Ok(false)
    }
}
