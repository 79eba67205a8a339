//! The training loop: rollout, update, log, checkpoint.
//!
//! Randomness: the environments' seed is the training's seed; initial weights, minibatch order and sampled actions have
//! streams of their own (see [`crate::random`]). One thread computes everything in one order, so that equal
//! configurations give equal weights, byte for byte, whatever the number of servers and of their workers.

use std::collections::VecDeque;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail};

use crate::algorithm::{Algorithm, Experience, UpdateStats};
use crate::checkpoint::{Checkpoint, Counters, EnvironmentSummary, State};
use crate::client::{EndedEpisode, OpenOptions, Servers, Session};
use crate::config::{TrainConfig, Wrapper};
use crate::interrupt::StopFlag;
use crate::logging::{Monitor, Progress, ProgressLog};
use crate::policy::{Inputs, ObservationNormaliser, Policy, RewardNormaliser, Weights};
use crate::rollout::{Collector, Normalisers, Rollout};

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

/// The directory of a run.
#[derive(Debug)]
pub struct RunDirectory {
    path: PathBuf,
    overwrite: bool,
}

impl RunDirectory {
    /// Chooses `path` for a new run; if it holds an earlier run, `overwrite` allows its deletion. Changes nothing yet:
    /// [`train`] empties the directory when the environments are open and all settings have proved to work.
    ///
    /// # Errors
    /// If it holds a run and `overwrite` is off; the operating system's.
    pub fn choose(path: &Path, overwrite: bool) -> Result<Self> {
        if path.exists() && !path.is_dir() {
            bail!("--out {} is a file; give a directory", path.display());
        }
        let directory = Self { path: path.to_owned(), overwrite };
        directory.earlier_run()?;
        Ok(directory)
    }

    /// The files of an earlier run, which may be deleted.
    fn earlier_run(&self) -> Result<Vec<PathBuf>> {
        let files = files_of_a_run(&self.path)?;
        if let (Some(file), false) = (files.first(), self.overwrite) {
            bail!(
                "{} already holds a run ({}): choose another --out, or give --overwrite to delete that run",
                self.path.display(),
                file.file_name().unwrap_or_default().to_string_lossy()
            );
        }
        Ok(files)
    }

    /// Creates it, or empties it of the earlier run.
    fn prepare(&self) -> Result<()> {
        let path = &self.path;
        for file in self.earlier_run()? {
            let removed = if file.is_dir() { fs::remove_dir_all(&file) } else { fs::remove_file(&file) };
            removed.with_context(|| format!("cannot delete {}", file.display()))?;
        }
        fs::create_dir_all(path).with_context(|| format!("cannot create {}", path.display()))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where its checkpoint is.
    pub fn checkpoint(&self) -> PathBuf {
        self.path.join("checkpoint")
    }
}

/// What a run has written in `path`; other files are left alone.
fn files_of_a_run(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let mut files = Vec::new();
    for entry in fs::read_dir(path).with_context(|| format!("cannot list {}", path.display()))? {
        let entry = entry.with_context(|| format!("cannot list {}", path.display()))?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let known = ["config.toml", "progress.csv", "monitor.csv", "checkpoint"].contains(&name.as_ref());
        if known || name.starts_with("events.out.tfevents.") {
            files.push(entry.path());
        }
    }
    files.sort();
    Ok(files)
}

/// Trains as `config` says and writes everything to `directory`; calls `report` after every iteration. When `stop` is
/// raised, the iteration is finished and the checkpoint written.
///
/// # Errors
/// A server that is lost, numbers that are not finite, a full disk. The checkpoint of the last whole iteration has then
/// been written, unless writing itself fails.
pub fn train(
    servers: &Servers,
    config: &TrainConfig,
    directory: &RunDirectory,
    stop: &StopFlag,
    mut report: impl FnMut(&Progress),
) -> Result<Outcome> {
    let mut training = Training::begin(servers, config)?;
    directory.prepare()?; // from here on an earlier run is gone
    tracing::debug!(directory = %directory.path().display(), "training begins");
    let mut log = Logs::create(config, directory, &training.summary)?;
    fs::write(directory.path().join("config.toml"), config.to_toml()).context("cannot write config.toml")?;
    let mut saved_at = None;
    loop {
        let progress = match training.iterate(&mut log) {
            Ok(progress) => progress,
            Err(error) => {
                log.flush()?;
                let counters = training.whole.state.counters;
                let context = if counters.iterations == 0 {
                    "training failed in its first iteration".to_owned()
                } else {
                    training.whole.save(&directory.checkpoint())?;
                    format!(
                        "training failed; the policy after {} episodes is kept in {}",
                        counters.episodes,
                        directory.checkpoint().display()
                    )
                };
                return Err(error.context(context));
            }
        };
        report(&progress);
        let signal = stop.signal();
        let finished = progress.episodes >= config.common.episodes || signal.is_some();
        let interval = config.common.checkpoint_interval;
        let due = saved_at.is_none_or(|saved: u64| progress.episodes / interval > saved / interval);
        if finished || due {
            log.flush()?;
            training.whole.save(&directory.checkpoint())?;
            saved_at = Some(progress.episodes);
        }
        if finished || progress.iterations.is_multiple_of(config.common.log_interval) {
            log.progress.write(&progress).context("cannot write progress.csv")?;
        }
        if finished {
            return Ok(Outcome { checkpoint: training.whole, progress, signal });
        }
    }
}

/// A training between two iterations.
struct Training<'a> {
    servers: &'a Servers,
    config: &'a TrainConfig,
    summary: EnvironmentSummary,
    collector: Collector<'a>,
    rollout: Rollout,
    policy: Policy,
    algorithm: Box<dyn Algorithm>,
    /// The policy after the last whole iteration.
    whole: Checkpoint,
    recent: VecDeque<[f64; 3]>,
    start: Instant,
    updating: Duration,
    /// How long the last update took.
    last_update: Option<Duration>,
}

impl<'a> Training<'a> {
    fn begin(servers: &'a Servers, config: &'a TrainConfig) -> Result<Self> {
        let common = &config.common;
        let options = OpenOptions {
            environment: common.environment.clone(),
            version: common.version.to_proto(),
            num_envs: common.num_envs,
            seed: common.seed,
            episodes_per_trial: config.settings.episodes_per_trial(),
        };
        let mut observations = Vec::new();
        let session = Session::open(servers, &options, &mut observations)?;
        let summary = EnvironmentSummary::of(session.environment())
            .context("the server does not say what actions the environment takes: are both of one version?")?;
        let observation_size = session.observation_size();
        let with_outcomes = common.algorithm.wrapper() == Wrapper::Rl2;
        let inputs = Inputs::new(observation_size, summary.action, common.num_envs, with_outcomes);
        let spec = common.architecture.spec(inputs.size(), summary.action);
        let policy = Policy::new(spec.clone(), common.seed)?;
        let algorithm = config.algorithm(&policy)?;
        let normalisers = Normalisers {
            observations: common.normalize_observations.then(|| ObservationNormaliser::new(observation_size)),
            rewards: common.normalize_rewards.then(|| RewardNormaliser::new(common.num_envs, config.settings.gamma())),
        };
        let (n_envs, input_size, width) = (common.num_envs, inputs.size(), summary.action.width());
        let rollout = match algorithm.experience() {
            Experience::Steps(n_steps) => Rollout::new(n_steps, n_envs, input_size, width),
            Experience::Episodes(_) => Rollout::of_episodes(n_envs, input_size, width),
        };
        let collector = Collector::new(session, observations, &spec, inputs, normalisers, common.seed)?;
        let whole = Checkpoint {
            state: State {
                environment: common.environment.clone(),
                environment_spec: summary.clone(),
                algorithm: common.algorithm,
                architecture: common.architecture,
                policy: spec,
                train_version: common.version,
                episodes_per_trial: options.episodes_per_trial,
                seed: common.seed,
                observation_normaliser: None,
                reward_normaliser: None,
                counters: Counters::default(),
                config: config.table(),
            },
            weights: policy.weights(),
        };
        Ok(Self {
            servers,
            config,
            summary,
            collector,
            rollout,
            policy,
            algorithm,
            whole,
            recent: VecDeque::with_capacity(RECENT),
            start: Instant::now(),
            updating: Duration::ZERO,
            last_update: None,
        })
    }

    /// A rollout and an update.
    fn iterate(&mut self, log: &mut Logs) -> Result<Progress> {
        let mut counters = self.whole.state.counters;
        let mut written = Ok(());
        let (mut ended, mut steps) = (0, 0);
        let Self { collector, rollout, recent, whole, algorithm, .. } = self;
        let on_episode = |episode: &EndedEpisode| {
            ended += 1;
            steps += u64::from(episode.length);
            remember(recent, episode);
            if written.is_ok() {
                written = log.monitor.write(episode);
            }
        };
        match algorithm.experience() {
            Experience::Steps(_) => {
                collector.collect(&whole.weights, rollout, on_episode)?;
                steps = (rollout.n_steps() * rollout.n_envs()) as u64;
            }
            Experience::Episodes(count) => collector.collect_episodes(&whole.weights, count, rollout, on_episode)?,
        }
        written.context("cannot write monitor.csv")?;

        let updating = Instant::now();
        let progress_remaining = self.progress_remaining(counters.learned_timesteps);
        let Self { algorithm, policy, rollout, .. } = self;
        let mut update = || algorithm.update(policy, rollout, progress_remaining);
        // A thread for it would cost more than the shortest updates; all updates of a training take about as long.
        let update = match self.last_update {
            Some(last) if last < LONG_UPDATE => update()?,
            _ => self.servers.keep_alive_during(update)?,
        };
        let weights = self.policy.weights();
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
        self.keep(weights, counters);
        Ok(self.progress(update))
    }

    /// 1 at the start, 0 when as many steps were learned from as the budget's episodes can have at most.
    fn progress_remaining(&self, timesteps: u64) -> f64 {
        let most = self.config.common.episodes as f64 * f64::from(self.summary.step_limit);
        (1.0 - timesteps as f64 / most).max(0.0)
    }

    /// Remembers the state after a whole iteration.
    fn keep(&mut self, weights: Weights, counters: Counters) {
        let Normalisers { observations, rewards } = self.collector.normalisers().clone();
        self.whole.weights = weights;
        self.whole.state.observation_normaliser = observations;
        self.whole.state.reward_normaliser = rewards;
        self.whole.state.counters = counters;
    }

    fn progress(&self, update: UpdateStats) -> Progress {
        let Counters { iterations, timesteps, episodes, generated_episodes, .. } = self.whole.state.counters;
        let times = self.collector.times();
        let mean = |i: usize| self.recent.iter().map(|episode| episode[i]).sum::<f64>() / self.recent.len() as f64;
        Progress {
            iterations,
            timesteps,
            elapsed: self.start.elapsed().as_secs_f64(),
            shares: [times.acting, times.waiting, self.updating].map(|time| time.as_secs_f64()),
            episodes,
            generated_episodes,
            recent: (!self.recent.is_empty()).then(|| [mean(0), mean(1), mean(2)]),
            update,
        }
    }
}

fn remember(recent: &mut VecDeque<[f64; 3]>, episode: &EndedEpisode) {
    if recent.len() == RECENT {
        recent.pop_front();
    }
    recent.push_back([episode.episode_return, f64::from(episode.length), f64::from(u8::from(episode.success))]);
}

/// The files that grow.
struct Logs {
    monitor: Monitor,
    progress: ProgressLog,
}

impl Logs {
    fn create(config: &TrainConfig, directory: &RunDirectory, summary: &EnvironmentSummary) -> Result<Self> {
        let t_start = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64();
        let path = directory.path().join("monitor.csv");
        let monitor = Monitor::create(&path, &config.common.environment, &summary.parameters, t_start)
            .with_context(|| format!("cannot create {}", path.display()))?;
        let progress = ProgressLog::create(directory.path(), t_start)
            .with_context(|| format!("cannot create the logs in {}", directory.path().display()))?;
        Ok(Self { monitor, progress })
    }

    fn flush(&mut self) -> Result<()> {
        self.monitor.flush().context("cannot write monitor.csv")
    }
}
