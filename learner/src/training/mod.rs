//! The training loop: rollout, update, log, checkpoint.
//!
//! Randomness: the environments' seed is the training's seed; initial weights, minibatch order and sampled actions have
//! streams of their own (see [`perturb_policy::random`]). Every sum has one order, so that equal configurations give equal
//! weights, byte for byte, whatever the number of servers, of their workers and of threads.

mod error;
mod run_directory;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::algorithm::{self, Algorithm, Experience, UpdateStats};
use crate::checkpoint::{Checkpoint, EnvironmentSummary, History, ResumeState, State};
use crate::client::{EndedEpisode, OpenOptions, Servers, Session};
use crate::logging::{Clock, EpisodeFigures, Logs, Progress, TimeShares};
use crate::policy::Policy;
use crate::rollout::{Collector, Normalisers, Rollout};
pub use error::{LastCheckpoint, TrainError};
use perturb_policy::{ObservationNormaliser, RewardNormaliser};
use perturb_study::Counters;
use perturb_study::files::write_atomically;
use perturb_study::interrupt::StopFlag;
use perturb_study::records::Comparison;
use perturb_study::settings::{Common, TrainConfig};
pub use run_directory::{RunDirectory, RunDirectoryError};

type Result<T> = std::result::Result<T, TrainError>;

/// Means are over so many episodes, as in stable-baselines3.
const RECENT: usize = 100;
/// During longer updates the connections are kept alive; servers wait for seconds at least.
const LONG_UPDATE: Duration = Duration::from_millis(100);

/// What a training came to.
#[derive(Debug)]
pub struct Outcome {
    /// The last checkpoint, as written.
    pub checkpoint: Checkpoint,
    /// The last figures.
    pub progress: Progress,
    /// The signal that ended the training before its budget; `None` if it ran to its end.
    pub signal: Option<i32>,
}

/// Trains as `config` says, with `threads` threads in updates, which change no byte, and writes everything to `directory`; calls `report` after every iteration. When `stop` is
/// raised, the iteration is finished and the checkpoint written.
///
/// # Errors
/// A server that is lost, numbers that are not finite, a full disk. The last checkpoint in the directory stays as it is.
pub fn train(
    servers: &Servers,
    config: &TrainConfig,
    directory: &RunDirectory,
    threads: usize,
    stop: &StopFlag,
    report: impl FnMut(&Progress),
) -> Result<Outcome> {
    let mut training = Training::begin(servers, config, threads)?;
    directory.prepare()?; // from here on an earlier run is gone
    tracing::debug!(directory = %directory.path().display(), "training begins");
    let Common { environment, .. } = &config.common;
    let spec = &training.checkpoint.state.environment_spec;
    let mut logs = Logs::create(directory.path(), environment, spec, training.clock)?;
    write_atomically(&directory.path().join("config.toml"), config.to_toml().as_bytes())?;
    training.run(&mut logs, directory, stop, report)
}

/// Goes on with the run in `directory` from its last `checkpoint` to the same bytes as without the break, times aside;
/// otherwise as [`train`]. `servers` may be others than before. What the logs hold
/// beyond the checkpoint is deleted.
///
/// # Errors
/// Those of [`train`]; an environment, a state or a log that does not fit the checkpoint, before anything is changed.
pub fn resume(
    servers: &Servers,
    directory: &RunDirectory,
    (checkpoint, state): (Checkpoint, ResumeState),
    threads: usize,
    stop: &StopFlag,
    report: impl FnMut(&Progress),
) -> Result<Outcome> {
    let lengths = state.history.logs.clone();
    let mut training = Training::resume(servers, checkpoint, state, threads)?;
    let mut logs =
        Logs::resume(directory.path(), &lengths, &training.checkpoint.state.environment_spec, training.clock)?;
    tracing::debug!(directory = %directory.path().display(), "training goes on");
    training.run(&mut logs, directory, stop, report)
}

/// A training between two iterations.
struct Training<'a> {
    servers: &'a Servers,
    collector: Collector<'a>,
    rollout: Rollout,
    policy: Policy,
    algorithm: Box<dyn Algorithm>,
    /// Of what episodes were to run with and ran with.
    comparison: Comparison,
    /// After the last whole iteration.
    checkpoint: Checkpoint,
    recent: VecDeque<EpisodeFigures>,
    clock: Clock,
    /// In earlier processes.
    shares_before: TimeShares,
    updating: Duration,
    /// How long the last update took.
    last_update: Option<Duration>,
    /// What the last checkpoint on disk counts.
    saved: Option<Counters>,
}

impl<'a> Training<'a> {
    fn begin(servers: &'a Servers, config: &TrainConfig, threads: usize) -> Result<Self> {
        let common = &config.common;
        let mut observations = Vec::new();
        let (session, summary) = open(servers, config, &mut observations)?;
        let observation_size = session.observation_size();
        let comparison = Comparison::of(session.environment());
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
            observations: common.normalize_observations.then(|| ObservationNormaliser::new(observation_size)),
            rewards: common.normalize_rewards.then(|| RewardNormaliser::new(common.num_envs, config.settings.gamma())),
        };
        let inputs = state.inputs(common.num_envs);
        let collector = Collector::new(session, observations, &spec, inputs, normalisers, common.seed)?;
        let weights = policy.weights();
        Self::new(servers, policy, collector, comparison, Checkpoint { state, policy: spec, weights })
    }

    fn resume(servers: &'a Servers, checkpoint: Checkpoint, resume: ResumeState, threads: usize) -> Result<Self> {
        let state = &checkpoint.state;
        let common = &state.config.common;
        let (session, served) = open(servers, &state.config, &mut Vec::new())?;
        if let Some((what, trained, served)) = state.environment_spec.difference(&served) {
            return Err(TrainError::Changed { environment: common.environment.clone(), what, trained, served });
        }
        let comparison = Comparison::of(session.environment());
        let policy = Policy::from_weights(checkpoint.policy.clone(), &checkpoint.weights)?.with_threads(threads)?;
        let normalisers = Normalisers {
            observations: state.observation_normaliser.clone(),
            rewards: state.reward_normaliser.clone(),
        };
        let inputs = state.inputs(common.num_envs);
        let collector = Collector::resume(session, &checkpoint.policy, inputs, normalisers, &resume.collector)
            .map_err(|error| TrainError::Restore { what: "environments", source: Box::new(error.into()) })?;
        let mut training = Self::new(servers, policy, collector, comparison, checkpoint)?;
        training
            .algorithm
            .load_state(&resume.algorithm)
            .map_err(|error| TrainError::Restore { what: "optimiser", source: Box::new(error.into()) })?;
        training.saved = Some(training.checkpoint.state.counters);
        training.recent.extend(&resume.history.recent);
        training.clock = Clock::start(resume.history.elapsed);
        training.shares_before = resume.history.shares;
        Ok(training)
    }

    /// With a fresh algorithm, and no past.
    fn new(
        servers: &'a Servers,
        policy: Policy,
        collector: Collector<'a>,
        comparison: Comparison,
        mut checkpoint: Checkpoint,
    ) -> Result<Self> {
        let State { config, commits, .. } = &mut checkpoint.state;
        let algorithm = algorithm::build(&config.settings, &policy, config.common.seed)?;
        if !commits.iter().any(|commit| commit == perturb_study::VERSION) {
            commits.push(perturb_study::VERSION.into());
        }
        let spec = policy.spec();
        let (n_envs, input_size, width) = (config.common.num_envs, spec.observation_size, spec.action.width());
        let rollout = match algorithm.experience() {
            Experience::Steps(n_steps) => Rollout::new(n_steps, n_envs, input_size, width),
            Experience::Episodes(_) => Rollout::of_episodes(n_envs, input_size, width),
        };
        Ok(Self {
            servers,
            collector,
            rollout,
            policy,
            algorithm,
            comparison,
            checkpoint,
            recent: VecDeque::with_capacity(RECENT),
            clock: Clock::start(0.0),
            shares_before: TimeShares::default(),
            updating: Duration::ZERO,
            last_update: None,
            saved: None,
        })
    }

    /// Iterations until the budget is used up or `stop` is raised.
    fn run(
        &mut self,
        logs: &mut Logs,
        directory: &RunDirectory,
        stop: &StopFlag,
        mut report: impl FnMut(&Progress),
    ) -> Result<Outcome> {
        let Common { episodes, log_interval, checkpoint_interval, .. } = self.checkpoint.state.config.common;
        loop {
            let progress = self.iterate(logs).map_err(|error| self.failed(error, directory))?;
            report(&progress);
            let finished = progress.episodes >= episodes;
            let signal = stop.signal().filter(|_| !finished);
            let logged = finished || progress.iterations.is_multiple_of(log_interval);
            if logged {
                logs.progress(&progress).map_err(|error| self.failed(error.into(), directory))?;
            }
            let due = |saved: Counters| progress.episodes / checkpoint_interval > saved.episodes / checkpoint_interval;
            if finished || self.saved.is_none_or(due) || signal.is_some() {
                self.save(logs, directory).map_err(|error| self.failed(error, directory))?;
            }
            if finished || signal.is_some() {
                if !logged {
                    logs.progress(&progress)?; // beyond the checkpoint: a run that is not stopped has no such line
                }
                return Ok(Outcome { checkpoint: self.checkpoint.clone(), progress, signal });
            }
        }
    }

    /// A rollout and an update.
    fn iterate(&mut self, logs: &mut Logs) -> Result<Progress> {
        let mut counters = self.checkpoint.state.counters;
        let mut written = Ok(());
        let mut not_applied = None;
        let (mut ended, mut steps) = (0, 0);
        let Self { collector, rollout, recent, policy, algorithm, comparison, .. } = self;
        let on_episode = |episode: &EndedEpisode| {
            if not_applied.is_none() {
                not_applied = difference(comparison, episode);
            }
            ended += 1;
            steps += u64::from(episode.length);
            remember(recent, episode);
            if written.is_ok() {
                written = logs.episode(episode);
            }
        };
        match algorithm.experience() {
            Experience::Steps(_) => {
                collector.collect(policy.flat_weights(), rollout, on_episode)?;
                steps = (rollout.n_steps() * rollout.n_envs()) as u64;
            }
            Experience::Episodes(count) => {
                collector.collect_episodes(policy.flat_weights(), count, rollout, on_episode)?
            }
        }
        written?;
        if let Some(error) = not_applied {
            return Err(error);
        }

        let updating = Instant::now();
        let progress_remaining = self.progress_remaining(counters.learned_timesteps);
        let Self { algorithm, policy, rollout, .. } = self;
        let mut update = || algorithm.update(policy, rollout, progress_remaining);
        // A thread for it would cost more than the shortest updates. The next update takes about as long as the last, with
        // EPOpt up to some ten times: still less than servers wait for.
        let update = match self.last_update {
            Some(last) if last < LONG_UPDATE => update()?,
            _ => self.servers.keep_alive_during(update)?,
        };
        let elapsed = updating.elapsed();
        self.last_update = Some(elapsed);
        self.updating += elapsed;

        let (learned_episodes, learned_steps) = match update.selection {
            Some(selection) => (selection.kept, selection.kept_steps),
            None => (ended, steps),
        };
        counters.iterations += 1;
        counters.timesteps += steps;
        counters.episodes += learned_episodes;
        counters.generated_episodes += ended;
        counters.learned_timesteps += learned_steps;
        self.keep(counters);
        Ok(self.progress(update))
    }

    /// 1 at the start, 0 when as many steps were learned from as the budget's episodes can have at most.
    fn progress_remaining(&self, timesteps: u64) -> f64 {
        let State { config, environment_spec, .. } = &self.checkpoint.state;
        let most = config.common.episodes as f64 * f64::from(environment_spec.step_limit);
        (1.0 - timesteps as f64 / most).max(0.0)
    }

    /// Remembers the state after a whole iteration.
    fn keep(&mut self, counters: Counters) {
        let Normalisers { observations, rewards } = self.collector.normalisers().clone();
        self.policy.copy_weights(&mut self.checkpoint.weights);
        self.checkpoint.state.observation_normaliser = observations;
        self.checkpoint.state.reward_normaliser = rewards;
        self.checkpoint.state.counters = counters;
    }

    /// Replaces the checkpoint on disk.
    fn save(&mut self, logs: &mut Logs, directory: &RunDirectory) -> Result<()> {
        // What the checkpoint counts on is on the disk before it.
        let history = History {
            logs: logs.sync()?,
            recent: self.recent.iter().copied().collect(),
            elapsed: self.clock.elapsed(),
            shares: self.shares(),
        };
        let state = ResumeState { collector: self.collector.state()?, algorithm: self.algorithm.state(), history };
        self.checkpoint.save(&directory.checkpoint(), Some(&state))?;
        self.saved = Some(self.checkpoint.state.counters);
        Ok(())
    }

    /// Says what is left of a training that `error` ended.
    fn failed(&self, error: TrainError, directory: &RunDirectory) -> TrainError {
        let last =
            self.saved.map(|Counters { episodes, .. }| LastCheckpoint { episodes, run: directory.path().to_owned() });
        TrainError::Failed { last, source: Box::new(error) }
    }

    fn shares(&self) -> TimeShares {
        let (before, now) = (self.shares_before, self.collector.times());
        TimeShares {
            acting: before.acting + now.acting.as_secs_f64(),
            waiting: before.waiting + now.waiting.as_secs_f64(),
            updating: before.updating + self.updating.as_secs_f64(),
        }
    }

    fn progress(&self, update: UpdateStats) -> Progress {
        let Counters { iterations, timesteps, episodes, generated_episodes, .. } = self.checkpoint.state.counters;
        Progress {
            iterations,
            timesteps,
            elapsed: self.clock.elapsed(),
            shares: self.shares(),
            episodes,
            generated_episodes,
            saved_timesteps: self.saved.map_or(0, |saved| saved.timesteps),
            recent: EpisodeFigures::mean(self.recent.iter()),
            update,
        }
    }
}

/// Opens the environments of a training.
fn open<'a>(
    servers: &'a Servers,
    config: &TrainConfig,
    observations: &mut Vec<f32>,
) -> Result<(Session<'a>, EnvironmentSummary)> {
    let common = &config.common;
    let options = OpenOptions {
        environment: common.environment.clone(),
        version: common.version,
        parameters: common.parameters.clone(),
        num_envs: common.num_envs,
        seed: common.seed,
        episodes_per_trial: config.settings.episodes_per_trial(),
    };
    let session = Session::open(servers, &options, observations)?;
    let summary = EnvironmentSummary::of(session.environment()).ok_or(TrainError::NoActions)?;
    Ok((session, summary))
}

/// Why an episode did not run with what was requested; `None` if it did.
fn difference(comparison: &Comparison, episode: &EndedEpisode) -> Option<TrainError> {
    let receipt = &episode.receipt;
    let difference = comparison.real_difference(&receipt.requested, &receipt.applied)?;
    let EndedEpisode { environment_index, episode_index, .. } = *episode;
    Some(TrainError::NotApplied { environment_index, episode_index, difference })
}

fn remember(recent: &mut VecDeque<EpisodeFigures>, episode: &EndedEpisode) {
    while recent.len() >= RECENT {
        recent.pop_front();
    }
    recent.push_back(episode.into());
}
