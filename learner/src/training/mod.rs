//! The training loop: collect rollouts, update policies, log, write checkpoints.
//!
//! [`train`] and [`resume`] train one run, and [`train_together`] trains several. All of them use the same loop,
//! `train_loop`. There are two ways to collect rollouts, which both implement `CollectRollouts`: `ClientSide` chooses
//! actions in this process, for all runs of a shared session together; `ServerSide` lets the server choose actions, in
//! a separate session for each run. A `Trainer` holds everything else of a run. docs/reading-ppo.md follows PPO from
//! the command line through this file to the weights.
//!
//! Determinism: the environments have the training's seed. Initial weights, minibatches and sampled actions have
//! separate random streams (see [`perturb_policy::random`]). Every sum is computed in a fixed order. So equal
//! configurations give equal weights, byte for byte. The weights do not depend on the numbers of servers, workers and
//! threads, on the place where actions are chosen, or on which trainings run together.

mod client_side;
mod ending;
mod entry;
mod error;
mod heuristic;
mod run_directory;
mod server_side;
mod start;
mod trainer;
mod untrained;

use std::time::Duration;

use bytes::Bytes;
use client_side::ClientSide;
pub use ending::is_over;
pub use entry::{Start, TrainOutcome, TrainRequest};
pub use error::{LastCheckpoint, TrainError};
use perturb_files::interrupt::StopFlag;
use perturb_policy::{Normalisers, Player, PlayerTrainingState};
use perturb_settings::TrainConfig;
pub use run_directory::{RunDirectory, RunDirectoryError, mark_in};
use server_side::ServerSide;
use trainer::Trainer;

use crate::checkpoint::{Checkpoint, ResumeState};
use crate::client::{Backoff, Reconnect, Servers};
use crate::logging::Progress;
use crate::policy::GradientWorkspace;

type Result<T> = std::result::Result<T, TrainError>;

/// If updates are expected to take longer than this, a thread keeps the connections alive during them. Servers drop a
/// silent connection after some seconds.
const LONG_UPDATE: Duration = Duration::from_millis(100);

/// Trains a policy with the settings of `config`, and writes logs and checkpoints to `directory`. Updates use `threads`
/// threads; the number does not affect the results. Calls `report` after every iteration. If `stop` is raised, finishes
/// the iteration, writes a checkpoint and returns.
///
/// After the loss of a server, [waits for it](crate::client::ServerWait) and resumes from the last checkpoint, with the
/// same bytes as without the loss.
///
/// # Errors
/// [`TrainError`] if a server stays lost, if numbers are not finite, or if files cannot be written. The last checkpoint
/// in the directory is kept.
pub fn train(
    servers: &Servers,
    config: &TrainConfig,
    directory: &RunDirectory,
    threads: usize,
    stop: &StopFlag,
    report: impl FnMut(&Progress),
) -> Result<TrainOutcome> {
    let start = Start::Fresh(Box::new(config.clone()));
    train_with_retry(servers, TrainRequest { directory, start, marks: &[] }, threads, stop, report)
}

/// Resumes the run in `directory` from its last `checkpoint`. Otherwise works like [`train`]. The results have the same
/// bytes as without the interruption, except for times. `servers` may be different from before. Deletes log lines after
/// the checkpoint.
///
/// # Errors
/// The errors of [`train`]. Also an error, before anything is changed, if the environment, the state or a log does not
/// fit the checkpoint.
pub fn resume(
    servers: &Servers,
    directory: &RunDirectory,
    checkpoint: (Checkpoint, ResumeState),
    threads: usize,
    stop: &StopFlag,
    report: impl FnMut(&Progress),
) -> Result<TrainOutcome> {
    let start = Start::Checkpoint(Box::new(checkpoint));
    train_with_retry(servers, TrainRequest { directory, start, marks: &[] }, threads, stop, report)
}

/// Trains one run. Each time that servers are lost and come back, resumes the run from its last checkpoint.
fn train_with_retry(
    servers: &Servers,
    entry: TrainRequest<'_>,
    threads: usize,
    stop: &StopFlag,
    mut report: impl FnMut(&Progress),
) -> Result<TrainOutcome> {
    let TrainRequest { directory, mut start, marks } = entry;
    let config = start.config().clone();
    let mut backoff = Backoff::default();
    let mut saved = start.timesteps();
    loop {
        let mut outcome = None;
        let attempt = train_together(
            servers,
            vec![TrainRequest { directory, start, marks }],
            threads,
            stop,
            &mut |_, progress| {
                if progress.saved_timesteps > saved {
                    saved = progress.saved_timesteps;
                    backoff.reset();
                }
                report(progress);
            },
            &mut |_, end| outcome = Some(end),
        );
        let ended = || outcome.unwrap_or_else(|| unreachable!("a training ends with an outcome or an error"));
        let error = match attempt.and_then(|()| ended()) {
            Ok(outcome) => return Ok(outcome),
            Err(error) => error,
        };
        let Some(lost) = error.of_server() else { return Err(error) };
        match backoff.reconnect(servers, lost, stop) {
            Reconnect::Connected => start = Start::resume_point(directory, &config)?,
            Reconnect::TimedOut => return Err(error),
            Reconnect::Stopped { signal } => return Err(TrainError::Stopped { signal, source: Box::new(error) }),
        }
    }
}

/// Trains several runs in the same environment. Each run gives the same bytes as with [`train`] or [`resume`] alone.
///
/// Runs with short rollouts share one session and step together. Runs with long rollouts get a separate session each,
/// and the server chooses their actions. For runs with observation noise, this process always chooses the actions.
/// Calls `report` after every iteration of a run, and `ended` at the end of a run, with the run's index in `entries`.
/// If a run fails, the others continue.
///
/// # Errors
/// [`TrainError`] if a session cannot be opened, or if the shared session fails, which ends all its runs. Their last
/// checkpoints are kept.
pub fn train_together(
    servers: &Servers,
    entries: Vec<TrainRequest<'_>>,
    threads: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
    ended: &mut dyn FnMut(usize, Result<TrainOutcome>),
) -> Result<()> {
    let learns = |(_, entry): &(usize, TrainRequest<'_>)| entry.start.config().settings.learns();
    let (entries, untrained): (Vec<_>, Vec<_>) = entries.into_iter().enumerate().partition(learns);
    for (index, entry) in untrained {
        ended(index, untrained::make(servers, &entry));
    }
    let (mut server_side, runs, others) = ServerSide::open(servers, entries, threads, ended)?;
    train_loop(servers, &mut server_side, runs, stop, report, ended)?;
    if others.is_empty() {
        return Ok(());
    }
    let (mut client_side, runs) = ClientSide::open(servers, others, threads, ended)?;
    train_loop(servers, &mut client_side, runs, stop, report, ended)
}

/// A training run in the training loop.
struct Run<'a> {
    /// The index among the runs that were started together.
    index: usize,
    trainer: Trainer<'a>,
    /// The outcome of the run; `None` until it has ended.
    end: Option<Result<TrainOutcome>>,
}

impl Run<'_> {
    /// Returns the value of `result`. If `result` is an error, ends the run with this error and returns `None`.
    ///
    /// # Errors
    /// An error of a server if the run's session `is_shared`, because such an error ends the other runs too.
    fn store_error<T>(&mut self, result: Result<T>, is_shared: bool) -> Result<Option<T>> {
        match result {
            Ok(value) => Ok(Some(value)),
            Err(error @ TrainError::Client(_)) if is_shared => Err(error),
            Err(error) => {
                self.end = Some(Err(self.trainer.failed(error)));
                Ok(None)
            }
        }
    }
}

/// A run with a complete rollout, and the time that collecting it took.
struct Collected {
    /// The index of the run.
    index: usize,
    /// Time spent on choosing actions in this process.
    acting: Duration,
    /// Time spent on waiting for servers.
    waiting: Duration,
}

/// A way to collect the rollouts of all runs of a training loop. Methods identify a run by its index.
trait CollectRollouts {
    /// Collects until at least one run has a complete rollout, or a run has failed. Returns the runs with complete
    /// rollouts, in the order in which they should be updated.
    ///
    /// # Errors
    /// A failure that ends all runs. A failure of a single run is stored in the run.
    fn collect(&mut self, runs: &mut [Run<'_>]) -> Result<Vec<Collected>>;

    /// Returns the player of a run, which must load new weights after an update. Returns `None` if the server acts.
    fn player(&mut self, index: usize) -> Option<&mut Player>;

    /// Returns the state and the normalisers of a run's player between two rollouts; `None` before the first rollout.
    ///
    /// # Errors
    /// Connection failures.
    fn player_state(&mut self, index: usize) -> Result<Option<(PlayerTrainingState, Normalisers)>>;

    /// Returns snapshots of a run's environments between two rollouts.
    ///
    /// # Errors
    /// Connection failures.
    fn snapshots(&mut self, index: usize) -> Result<Vec<Bytes>>;

    /// Frees the environments of a run that has ended.
    ///
    /// # Errors
    /// Failures of a shared connection.
    fn release(&mut self, index: usize) -> Result<()>;

    /// Returns whether all runs share a session, so that a failure of its connection ends all of them.
    fn is_shared(&self) -> bool;
}

/// Trains `runs` until all have ended. Calls `ended` with the index and the outcome of each run.
///
/// # Errors
/// A failure of a shared session. Runs that have not ended can be resumed from their checkpoints.
fn train_loop(
    servers: &Servers,
    collector: &mut dyn CollectRollouts,
    mut runs: Vec<Run<'_>>,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
    ended: &mut dyn FnMut(usize, Result<TrainOutcome>),
) -> Result<()> {
    runs.iter_mut().for_each(|run| run.trainer.policy.set_stop(servers.stop()));
    let mut workspace = if let [first, _, ..] = runs.as_slice() { first.trainer.workspace()? } else { None };
    while !runs.is_empty() {
        let iteration = train_iteration(servers, collector, &mut runs, &mut workspace, stop, report);
        // Removes runs that have ended, and reports their outcomes.
        let mut released = Vec::new();
        while let Some(place) = runs.iter().position(|run| run.end.is_some()) {
            let Run { index, end, .. } = runs.remove(place);
            end.into_iter().for_each(|end| ended(index, end));
            released.push(index);
        }
        if let Err(error) = iteration {
            return Err(match runs.as_slice() {
                [alone] => alone.trainer.failed(error),
                _ => error,
            });
        }
        if !runs.is_empty() {
            released.into_iter().try_for_each(|index| collector.release(index))?;
        } // after the last run, the whole session is closed
    }
    Ok(())
}

/// Collects until some runs have complete rollouts; then updates these runs, logs, and saves checkpoints.
fn train_iteration(
    servers: &Servers,
    collector: &mut dyn CollectRollouts,
    runs: &mut [Run<'_>],
    workspace: &mut Option<GradientWorkspace>,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
) -> Result<()> {
    let collected = collector.collect(runs)?;
    let is_shared = collector.is_shared();
    let mut updated: Vec<(usize, Progress)> = Vec::with_capacity(collected.len());
    let expected: Duration = collected.iter().filter_map(|it| Some(find(runs, it.index)?.trainer.last_update())).sum();
    keep_alive(servers, expected, || {
        for Collected { index, acting, waiting } in collected {
            let Some(run) = find(runs, index) else { continue };
            let progress = run.trainer.update(collector.player(index), workspace.as_mut(), acting, waiting);
            updated.extend(run.store_error(progress, is_shared)?.map(|progress| (index, progress)));
        }
        Ok::<(), TrainError>(())
    })?;
    updated.sort_by_key(|(index, _)| *index); // reports are in the order of runs, regardless of the order of updates
    for (index, progress) in updated {
        let Some(run) = find(runs, index) else { continue };
        report(index, &progress);
        let finished = finish_iteration(collector, run, progress, stop);
        run.store_error(finished, is_shared)?;
    }
    Ok(())
}

/// Logs an iteration of a run, saves the policy or a checkpoint if due, and ends the run if it is over.
fn finish_iteration(
    collector: &mut dyn CollectRollouts,
    run: &mut Run<'_>,
    progress: Progress,
    stop: &StopFlag,
) -> Result<()> {
    let Run { index, trainer, end } = run;
    let iteration = trainer.finish_iteration(progress, stop)?;
    if (iteration.save || !iteration.marks.is_empty())
        && let Some((player, normalisers)) = collector.player_state(*index)?
    {
        trainer.keep(&iteration, &normalisers)?;
        if iteration.save {
            trainer.save(collector.snapshots(*index)?, player, normalisers)?;
        }
    }
    if iteration.ends {
        *end = Some(Ok(trainer.end(&iteration)?));
    }
    Ok(())
}

/// Returns the run with this index.
fn find<'r, 'a>(runs: &'r mut [Run<'a>], index: usize) -> Option<&'r mut Run<'a>> {
    runs.iter_mut().find(|run| run.index == index)
}

/// Runs `work`. If it is `expected` to take long, keeps the connections alive meanwhile.
fn keep_alive<T>(servers: &Servers, expected: Duration, work: impl FnOnce() -> T) -> T {
    if expected < LONG_UPDATE { work() } else { servers.keep_alive_during(work) }
}
