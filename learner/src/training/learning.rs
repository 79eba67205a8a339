//! A training but for its environments: what learns, counts, logs and writes checkpoints.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use super::ending::{RECENT, is_over};
use super::{LastCheckpoint, Outcome, Result, RunDirectory, TrainError};
use crate::algorithm::{self, Algorithm, UpdateStats};
use crate::checkpoint::{Checkpoint, EnvironmentSummary, History, ResumeState, State};
use crate::client::{EndedEpisode, OpenOptions, Servers};
use crate::logging::{Clock, EpisodeFigures, Logs, Progress, TimeShares};
use crate::policy::{Policy, Room};
use crate::proto;
use crate::rollout::{CollectorState, Rollout};
use perturb_policy::{CollectUntil, Normalisers, Player, PlayerState, PolicySpec, RewardNormaliser, Role};
use perturb_study::Counters;
use perturb_study::files::write_atomically;
use perturb_study::interrupt::StopFlag;
use perturb_study::records::Comparison;
use perturb_study::settings::{Base, Common, EpoptConfig, Settings, TrainConfig, Wrapper};

/// During longer updates the connections are kept alive; servers wait for seconds at least.
const LONG_UPDATE: Duration = Duration::from_millis(100);

/// A training between two rollouts.
pub(super) struct Learning<'a> {
    directory: &'a RunDirectory,
    policy: Policy,
    algorithm: Box<dyn Algorithm>,
    rollout: Rollout,
    tally: Tally,
    logs: Logs,
    /// After the last whole iteration, but for weights and statistics, which are put in when it is saved.
    checkpoint: Checkpoint,
    clock: Clock,
    /// Where the time went, earlier processes included.
    shares: TimeShares,
    /// How long the last update took.
    last_update: Option<Duration>,
    /// What the last checkpoint on disk counts.
    saved: Option<Counters>,
    /// Episodes after which the policy of the moment is kept, without those that are past.
    marks: VecDeque<u64>,
}

/// What is noted of the episodes of a rollout.
pub(super) struct Tally {
    /// Of what episodes were to run with and ran with.
    comparison: Comparison,
    recent: VecDeque<EpisodeFigures>,
    /// To be written to the log.
    ended: Vec<EndedEpisode>,
}

/// How a training goes on after an iteration.
pub(super) struct Turn {
    pub(super) progress: Progress,
    /// A checkpoint is due.
    pub(super) save: bool,
    /// The marks that were passed.
    pub(super) marks: Vec<u64>,
    /// The budget is used up, or a signal came.
    pub(super) ends: bool,
    signal: Option<i32>,
    logged: bool,
}

/// What `config` trains with.
pub(super) fn options(config: &TrainConfig) -> OpenOptions {
    let common = &config.common;
    OpenOptions {
        environment: common.environment.clone(),
        version: common.version,
        parameters: common.parameters.clone(),
        num_envs: common.num_envs,
        seed: common.seed,
        episodes_per_trial: config.settings.episodes_per_trial(),
        observe: common.observe,
    }
}

impl<'a> Learning<'a> {
    /// A training from its beginning in `environment`, whose first `observations` `[N, O]` are given; an earlier run in
    /// the directory is gone then.
    pub(super) fn begin(
        config: &TrainConfig,
        directory: &'a RunDirectory,
        environment: &proto::Environment,
        observations: &[f32],
        threads: usize,
    ) -> Result<(Self, Player)> {
        let common = &config.common;
        let summary = EnvironmentSummary::of(environment).ok_or(TrainError::NoActions)?;
        let state = State {
            environment_spec: summary,
            observation_normaliser: None,
            reward_normaliser: None,
            counters: Counters::default(),
            config: config.clone(),
            commits: Vec::new(),
        };
        let spec = state.policy();
        let policy = Policy::new(spec.clone(), common.seed)?.with_threads(threads)?;
        let normalisers = Normalisers {
            observations: state.fresh_normaliser(),
            rewards: common.normalize_rewards.then(|| {
                let normaliser = RewardNormaliser::new(common.num_envs, config.settings.gamma());
                normaliser.running_on(common.reward_return_runs_on)
            }),
        };
        let mut player = player(&state, normalisers);
        player.begin(observations, None).map_err(crate::error::Error::from)?;
        player.load(policy.flat_weights()).map_err(crate::error::Error::from)?;
        let weights = policy.weights();
        let checkpoint = Checkpoint { state, policy: spec, weights };
        directory.prepare()?; // from here on an earlier run is gone
        tracing::debug!(directory = %directory.path().display(), "training begins");
        let (path, clock) = (directory.path(), Clock::start(0.0));
        let logs = Logs::create(path, &common.environment, &checkpoint.state.environment_spec, clock)?;
        write_atomically(&path.join("config.toml"), config.to_toml().as_bytes())?;
        Ok((Self::new(directory, policy, environment, checkpoint, logs, clock)?, player))
    }

    /// A training that goes on from a checkpoint; `restore` brings its environments back. What the logs hold beyond it is
    /// deleted, at last.
    pub(super) fn resume(
        (checkpoint, resume): (Checkpoint, &ResumeState),
        directory: &'a RunDirectory,
        environment: &proto::Environment,
        threads: usize,
        restore: impl FnOnce() -> Result<()>,
    ) -> Result<(Self, Player)> {
        let state = &checkpoint.state;
        let served = EnvironmentSummary::of(environment).ok_or(TrainError::NoActions)?;
        if let Some((what, trained, served)) = state.environment_spec.difference(&served) {
            let environment = state.config.common.environment.clone();
            return Err(TrainError::Changed { environment, what, trained, served });
        }
        let policy = Policy::from_weights(checkpoint.policy.clone(), &checkpoint.weights)?.with_threads(threads)?;
        let normalisers = Normalisers {
            observations: state.observation_normaliser.clone(),
            rewards: state.reward_normaliser.clone(),
        };
        let mut player = player(state, normalisers);
        let played = player.restore(&resume.collector.player).map_err(crate::error::Error::from);
        played.map_err(|error| not_restored("environments", error.into()))?;
        player.load(policy.flat_weights()).map_err(crate::error::Error::from)?;
        restore()?;
        let clock = Clock::start(resume.history.elapsed);
        let mut algorithm = algorithm::build(&state.config.settings, &policy, state.config.common.seed)?;
        let loaded = algorithm.load_state(&resume.algorithm);
        loaded.map_err(|error| not_restored("optimiser", error.into()))?;
        let logs = Logs::resume(directory.path(), &resume.history.logs, &state.environment_spec, clock)?;
        tracing::debug!(directory = %directory.path().display(), "training goes on");
        let mut learning = Self::new(directory, policy, environment, checkpoint, logs, clock)?;
        learning.algorithm = algorithm;
        learning.saved = Some(learning.checkpoint.state.counters);
        learning.tally.recent.extend(&resume.history.recent);
        learning.shares = resume.history.shares;
        Ok((learning, player))
    }

    /// With a fresh algorithm, and no past.
    fn new(
        directory: &'a RunDirectory,
        policy: Policy,
        environment: &proto::Environment,
        mut checkpoint: Checkpoint,
        logs: Logs,
        clock: Clock,
    ) -> Result<Self> {
        let State { config, commits, .. } = &mut checkpoint.state;
        let algorithm = algorithm::build(&config.settings, &policy, config.common.seed)?;
        if !commits.iter().any(|commit| commit == perturb_study::VERSION) {
            commits.push(perturb_study::VERSION.into());
        }
        let spec = policy.spec();
        let (n_envs, input_size, width) = (config.common.num_envs, spec.observation_size, spec.action.width());
        let rollout = match algorithm.collect_until() {
            CollectUntil::Steps(n_steps) => Rollout::new(n_steps, n_envs, input_size, width),
            CollectUntil::Episodes(_) => Rollout::of_episodes(n_envs, input_size, width),
        };
        Ok(Self {
            directory,
            policy,
            algorithm,
            rollout,
            tally: Tally {
                comparison: Comparison::of(environment),
                recent: VecDeque::with_capacity(RECENT),
                ended: Vec::new(),
            },
            logs,
            checkpoint,
            clock,
            shares: TimeShares::default(),
            last_update: None,
            saved: None,
            marks: VecDeque::new(),
        })
    }

    /// Keeps the policies of those of `marks` that are to come; the others were kept when they came.
    pub(super) fn keep_at(&mut self, marks: &[u64]) {
        let episodes = self.checkpoint.state.counters.episodes;
        self.marks = marks.iter().copied().filter(|mark| *mark > episodes).collect();
    }

    pub(super) fn spec(&self) -> &PolicySpec {
        self.policy.spec()
    }

    pub(super) fn collect_until(&self) -> CollectUntil {
        self.algorithm.collect_until()
    }

    /// `[P]` the weights.
    pub(super) fn weights(&self) -> &[f32] {
        self.policy.flat_weights()
    }

    /// Where a rollout and its episodes go.
    pub(super) fn collecting(&mut self) -> (&mut Rollout, &mut Tally) {
        (&mut self.rollout, &mut self.tally)
    }

    /// Whether connections should be kept alive during the next update. A thread for it would cost more than the shortest
    /// updates. The next update takes about as long as the last, with EPOpt up to some ten times: still less than servers
    /// wait for.
    pub(super) fn last_update(&self) -> Duration {
        self.last_update.unwrap_or(LONG_UPDATE)
    }

    /// See [`Policy::room`].
    pub(super) fn room(&self) -> Result<Option<Room>> {
        Ok(self.policy.room()?)
    }

    /// Learns from the rollout, which took so long to collect, and notes what came of it. A `player` that collected it here
    /// has the new weights then.
    pub(super) fn learn(
        &mut self,
        mut player: Option<&mut Player>,
        acting: Duration,
        waiting: Duration,
    ) -> Result<Progress> {
        let (ended, steps) = self.note_rollout()?;
        let updating = Instant::now();
        if let Some(player) = player.as_deref_mut() {
            self.policy.take_networks(player);
        }
        let remaining = self.progress_remaining();
        let update = self.algorithm.update(&mut self.policy, &self.rollout, remaining)?;
        if let Some(player) = player {
            // At once, while they are in the processor's caches.
            player.load(self.policy.flat_weights()).map_err(crate::error::Error::from)?;
        }
        let elapsed = updating.elapsed();
        self.last_update = Some(elapsed);
        self.shares.acting += acting.as_secs_f64();
        self.shares.waiting += waiting.as_secs_f64();
        self.shares.updating += elapsed.as_secs_f64();

        let (learned_episodes, learned_steps) = match update.selection {
            Some(selection) => (selection.kept, selection.kept_steps),
            None => (ended, steps),
        };
        let counters = &mut self.checkpoint.state.counters;
        counters.iterations += 1;
        counters.timesteps += steps;
        counters.episodes += learned_episodes;
        counters.generated_episodes += ended;
        counters.learned_timesteps += learned_steps;
        Ok(self.progress(update))
    }

    /// The same in a room that others use by turns.
    pub(super) fn learn_in(
        &mut self,
        room: &mut Room,
        player: Option<&mut Player>,
        acting: Duration,
        waiting: Duration,
    ) -> Result<Progress> {
        self.policy.change_room(room);
        let progress = self.learn(player, acting, waiting);
        self.policy.change_room(room);
        progress
    }

    /// Logs the rollout's episodes; gives their number and the steps that the rollout counts.
    fn note_rollout(&mut self) -> Result<(u64, u64)> {
        let Tally { comparison, ended, .. } = &mut self.tally;
        for episode in &*ended {
            self.logs.episode(episode)?;
        }
        if let Some(error) = ended.iter().find_map(|episode| difference(comparison, episode)) {
            return Err(error);
        }
        let steps = match self.algorithm.collect_until() {
            CollectUntil::Steps(_) => (self.rollout.n_steps() * self.rollout.n_envs()) as u64,
            CollectUntil::Episodes(_) => ended.iter().map(|episode| u64::from(episode.length)).sum(),
        };
        let count = ended.len() as u64;
        ended.clear();
        Ok((count, steps))
    }

    /// 1 at the start, 0 when as many steps were learned from as the budget's episodes can have at most. With an update for
    /// each episode all count as long as that, as in the reference, which fills them up.
    fn progress_remaining(&self) -> f64 {
        let State { config, environment_spec, counters, .. } = &self.checkpoint.state;
        if let Wrapper::Epopt(EpoptConfig { update_per_episode: true, .. }) = config.settings.wrapper {
            return (1.0 - counters.episodes as f64 / config.common.episodes as f64).max(0.0);
        }
        let most = config.common.episodes as f64 * f64::from(environment_spec.step_limit);
        (1.0 - counters.learned_timesteps as f64 / most).max(0.0)
    }

    /// Logs the iteration, if its turn has come, and says how it goes on.
    pub(super) fn turn(&mut self, progress: Progress, stop: &StopFlag) -> Result<Turn> {
        let State { config: TrainConfig { common, .. }, counters, .. } = &self.checkpoint.state;
        let Common { log_interval, checkpoint_interval, .. } = *common;
        let finished = is_over(common, counters, self.tally.recent.iter());
        let signal = stop.signal().filter(|_| !finished);
        let logged = finished || progress.iterations.is_multiple_of(log_interval);
        if logged {
            self.logs.progress(&progress)?;
        }
        let due = |saved: Counters| progress.episodes / checkpoint_interval > saved.episodes / checkpoint_interval;
        let save = finished || self.saved.is_none_or(due) || signal.is_some();
        let passed = |mark: &u64| finished || *mark <= progress.episodes; // one that stops early stays as it is
        let passed = self.marks.partition_point(passed);
        let marks = self.marks.drain(..passed).collect();
        Ok(Turn { progress, save, marks, ends: finished || signal.is_some(), signal, logged })
    }

    /// Puts the policy of the moment into the checkpoint.
    fn take_policy(&mut self, normalisers: Normalisers) {
        let Self { policy, checkpoint, .. } = self;
        policy.copy_weights(&mut checkpoint.weights);
        checkpoint.state.observation_normaliser = normalisers.observations;
        checkpoint.state.reward_normaliser = normalisers.rewards;
    }

    /// Keeps the policy of the moment for the marks that were passed. To be called before the next checkpoint is saved:
    /// what goes on from that does not come by these marks again.
    pub(super) fn keep(&mut self, turn: &Turn, normalisers: &Normalisers) -> Result<()> {
        if !turn.marks.is_empty() {
            self.take_policy(normalisers.clone());
        }
        turn.marks.iter().try_for_each(|&mark| Ok(self.checkpoint.save(&self.directory.mark(mark), None)?))
    }

    /// Replaces the checkpoint on disk; environments and player are those after the last iteration.
    pub(super) fn save(
        &mut self,
        snapshots: Vec<bytes::Bytes>,
        player: PlayerState,
        normalisers: Normalisers,
    ) -> Result<()> {
        self.take_policy(normalisers);
        // What the checkpoint counts on is on the disk before it.
        let history = History {
            logs: self.logs.sync()?,
            recent: self.tally.recent.iter().copied().collect(),
            elapsed: self.clock.elapsed(),
            shares: self.shares,
        };
        let collector = CollectorState { snapshots, player };
        let state = ResumeState { collector, algorithm: self.algorithm.state(), history };
        state.save(&self.checkpoint, &self.directory.checkpoint())?;
        self.saved = Some(self.checkpoint.state.counters);
        Ok(())
    }

    /// What the training came to, after the last iteration was saved.
    pub(super) fn end(&mut self, turn: &Turn) -> Result<Outcome> {
        if !turn.logged {
            self.logs.progress(&turn.progress)?; // beyond the checkpoint: a run that is not stopped has no such line
        }
        Ok(Outcome { checkpoint: self.checkpoint.clone(), progress: turn.progress, signal: turn.signal })
    }

    /// Says what is left of a training that `error` ended.
    pub(super) fn failed(&self, error: TrainError) -> TrainError {
        let run = || self.directory.path().to_owned();
        let last = self.saved.map(|Counters { episodes, .. }| LastCheckpoint { episodes, run: run() });
        TrainError::Failed { last, source: Box::new(error) }
    }

    fn progress(&self, update: UpdateStats) -> Progress {
        let Counters { iterations, timesteps, episodes, generated_episodes, .. } = self.checkpoint.state.counters;
        Progress {
            iterations,
            timesteps,
            elapsed: self.clock.elapsed(),
            shares: self.shares,
            episodes,
            generated_episodes,
            saved_timesteps: self.saved.map_or(0, |saved| saved.timesteps),
            recent: EpisodeFigures::mean(self.tally.recent.iter()),
            update,
        }
    }
}

impl Tally {
    pub(super) fn note(&mut self, episode: &EndedEpisode) {
        while self.recent.len() >= RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(episode.into());
        self.ended.push(episode.clone());
    }
}

/// The error of what a checkpoint holds and does not fit.
pub(super) fn not_restored(what: &'static str, source: TrainError) -> TrainError {
    TrainError::Restore { what, source: Box::new(source) }
}

/// The player of a training.
fn player(state: &State, normalisers: Normalisers) -> Player {
    let Common { num_envs, seed, observation_noise, .. } = state.config.common;
    let (spec, inputs) = (state.policy(), state.inputs(num_envs));
    let episodes_per_trial = state.config.settings.episodes_per_trial();
    let player = Player::new(&spec, inputs, num_envs, episodes_per_trial, normalisers, Role::training(seed));
    let player = player.with_noise(observation_noise);
    match &state.config.settings {
        // Its one update of a rollout needs just what acting has computed.
        Settings { base: Base::A2c(a2c), wrapper: Wrapper::Plain | Wrapper::Rl2(_) } => {
            player.keeping_activations(a2c.n_steps)
        }
        _ => player,
    }
}

/// Runs `work`, which takes about so long, and keeps the connections alive meanwhile if it is long.
pub(super) fn keep_alive<T>(servers: &Servers, expected: Duration, work: impl FnOnce() -> T) -> T {
    if expected < LONG_UPDATE { work() } else { servers.keep_alive_during(work) }
}

/// Why an episode did not run with what was requested; `None` if it did.
fn difference(comparison: &mut Comparison, episode: &EndedEpisode) -> Option<TrainError> {
    let receipt = &episode.receipt;
    let difference = comparison.real_difference(&receipt.requested, &receipt.applied)?;
    let EndedEpisode { environment_index, episode_index, .. } = *episode;
    Some(TrainError::NotApplied { environment_index, episode_index, difference })
}
