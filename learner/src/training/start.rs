//! Starts runs from initial weights or from a checkpoint.

use std::collections::VecDeque;
use std::ops::Range;

use perturb_checkpoint::Counters;
use perturb_files::write_atomically;
use perturb_policy::{CollectUntil, Normalisers, Player, PlayerRole, RewardNormaliser};
use perturb_records::ParameterComparison;
use perturb_settings::{Base, Common, Settings, TrainConfig, Wrapper};

use super::ending::RECENT;
use super::trainer::{EpisodeTally, Trainer};
use super::{Result, RunDirectory, Start, TrainError, TrainRequest};
use crate::checkpoint::{Checkpoint, EnvironmentSummary, ResumeState, State};
use crate::client::{ClientSession, OpenOptions};
use crate::logging::{Clock, Logs, TimeShares};
use crate::policy::TrainablePolicy;
use crate::rollout::RolloutBuffer;
use crate::{algorithm, proto};

/// Returns the options of the environments that `config` trains in.
pub(super) fn options(config: &TrainConfig) -> OpenOptions {
    let common = &config.common;
    OpenOptions {
        environment: common.environment.clone(),
        version: common.version,
        parameters: common.parameters.clone(),
        contexts: common.contexts.clone(),
        num_envs: common.num_envs,
        seed: common.seed,
        episodes_per_trial: config.settings.episodes_per_trial(),
        observe: common.observe,
    }
}

/// Prepares a run to start or resume in the `slots` of a session. Returns its trainer and its player. `observations`
/// `[N, O]` are the first observations of these environments.
pub(super) fn start_or_resume<'a>(
    entry: TrainRequest<'a>,
    session: &mut ClientSession<'_>,
    slots: Range<usize>,
    observations: &[f32],
    threads: usize,
) -> Result<(Trainer<'a>, Player)> {
    let environment = session.environment().clone();
    let TrainRequest { directory, start, marks } = entry;
    let (mut trainer, player) = match start {
        Start::Fresh(config) => begin(&config, directory, &environment, observations, threads)?,
        Start::Checkpoint(saved) => {
            let (checkpoint, state) = *saved;
            let restore = || {
                let restored = session.restore(slots, &state.collector.snapshots);
                restored.map(drop).map_err(|error| not_restored("environments", error.into()))
            };
            resume((checkpoint, &state), directory, &environment, threads, restore)?
        }
    };
    // Keeps only the marks that the training has not reached yet. The policies of earlier marks are already saved.
    let episodes = trainer.checkpoint.state.counters.episodes;
    trainer.marks = marks.iter().copied().filter(|mark| *mark > episodes).collect();
    Ok((trainer, player))
}

/// Starts a run from initial weights. `observations` `[N, O]` are the first observations of its environments. Deletes
/// an earlier run in the directory.
fn begin<'a>(
    config: &TrainConfig,
    directory: &'a RunDirectory,
    environment: &proto::Environment,
    observations: &[f32],
    threads: usize,
) -> Result<(Trainer<'a>, Player)> {
    let common = &config.common;
    let summary = EnvironmentSummary::from_environment(environment).ok_or(TrainError::NoActions)?;
    let state = State {
        environment_spec: summary,
        observation_normaliser: None,
        reward_normaliser: None,
        counters: Counters::default(),
        config: config.clone(),
        commits: Vec::new(),
    };
    let spec = state.policy();
    let policy = TrainablePolicy::new(spec.clone(), common.seed)?.with_threads(threads)?;
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
    directory.prepare()?; // this deletes an earlier run
    tracing::debug!(directory = %directory.path().display(), "training begins");
    let path = directory.path();
    let clock = Clock::start(0.0);
    let logs = Logs::create(path, &common.environment, &checkpoint.state.environment_spec, clock)?;
    write_atomically(&path.join("config.toml"), config.to_toml().as_bytes())?;
    Ok((new_trainer(directory, policy, environment, checkpoint, logs, clock)?, player))
}

/// Resumes a run from a checkpoint. `restore` restores its environments. As the last step, deletes log lines after the
/// checkpoint.
fn resume<'a>(
    (checkpoint, resume): (Checkpoint, &ResumeState),
    directory: &'a RunDirectory,
    environment: &proto::Environment,
    threads: usize,
    restore: impl FnOnce() -> Result<()>,
) -> Result<(Trainer<'a>, Player)> {
    let state = &checkpoint.state;
    let served = EnvironmentSummary::from_environment(environment).ok_or(TrainError::NoActions)?;
    if let Some((what, trained, served)) = state.environment_spec.difference(&served) {
        let environment = state.config.common.environment.clone();
        return Err(TrainError::Changed { environment, what, trained, served });
    }
    let policy =
        TrainablePolicy::from_weights(checkpoint.policy.clone(), &checkpoint.weights)?.with_threads(threads)?;
    let normalisers =
        Normalisers { observations: state.observation_normaliser.clone(), rewards: state.reward_normaliser.clone() };
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
    let mut trainer = new_trainer(directory, policy, environment, checkpoint, logs, clock)?;
    trainer.algorithm = algorithm;
    trainer.saved = Some(trainer.checkpoint.state.counters);
    trainer.tally.recent.extend(&resume.history.recent);
    trainer.shares = resume.history.shares;
    Ok((trainer, player))
}

/// Returns a trainer with a new algorithm state and no episodes.
fn new_trainer<'a>(
    directory: &'a RunDirectory,
    policy: TrainablePolicy,
    environment: &proto::Environment,
    mut checkpoint: Checkpoint,
    logs: Logs,
    clock: Clock,
) -> Result<Trainer<'a>> {
    let State { config, commits, .. } = &mut checkpoint.state;
    let algorithm = algorithm::build(&config.settings, &policy, config.common.seed)?;
    if !commits.iter().any(|commit| commit == perturb_experiment::VERSION) {
        commits.push(perturb_experiment::VERSION.into());
    }
    let spec = policy.spec();
    let n_envs = config.common.num_envs;
    let input_size = spec.observation_size;
    let width = spec.action.width();
    let rollout = match algorithm.collect_until() {
        CollectUntil::Steps(n_steps) => RolloutBuffer::new(n_steps, n_envs, input_size, width),
        CollectUntil::Episodes(_) => RolloutBuffer::of_episodes(n_envs, input_size, width),
    };
    Ok(Trainer {
        directory,
        policy,
        algorithm,
        rollout,
        tally: EpisodeTally {
            comparison: ParameterComparison::new(environment),
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

/// Returns the error for a part of a checkpoint that cannot be restored.
fn not_restored(what: &'static str, source: TrainError) -> TrainError {
    TrainError::Restore { what, source: Box::new(source) }
}

/// Returns the player of a run, with these normalisers.
fn player(state: &State, normalisers: Normalisers) -> Player {
    let Common { num_envs, seed, observation_noise, .. } = state.config.common;
    let spec = state.policy();
    let inputs = state.inputs(num_envs);
    let episodes_per_trial = state.config.settings.episodes_per_trial();
    let player = Player::new(&spec, inputs, num_envs, episodes_per_trial, normalisers, PlayerRole::training(seed));
    let player = player.with_noise(observation_noise);
    match &state.config.settings {
        // A2C makes one gradient step per rollout. It can use the activations that acting has already computed.
        Settings { base: Base::A2c(a2c), wrapper: Wrapper::Plain | Wrapper::Rl2(_) } => {
            player.keeping_activations(a2c.n_steps)
        }
        _ => player,
    }
}
