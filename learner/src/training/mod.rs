//! The training loop: collect rollouts, update policies, log, write checkpoints.
//!
//! [`train`] and [`resume`] train one run, [`train_together`] several. All end in one loop, `train_loop`. Runs differ in
//! who chooses actions: this process, for all runs of one session in lockstep (`ClientSide`; a run alone is a lockstep of
//! one), or the server, in a session for each run (`ServerSide`). Both implement `CollectRollouts`. A `Trainer` holds
//! everything else of a run. docs/reading-ppo.md follows PPO from the command line through this file to the weights.
//!
//! Randomness: the environments' seed is the training's seed; initial weights, minibatch order and sampled actions have
//! streams of their own (see [`perturb_policy::random`]). Every sum has one order, so that equal configurations give equal
//! weights, byte for byte, whatever the number of servers, of their workers and of threads, wherever actions are chosen,
//! and whichever trainings run together.

mod client_side;
mod ending;
mod entry;
mod error;
mod random;
mod run_directory;
mod server_side;
mod start;
mod trainer;

use std::time::Duration;

use bytes::Bytes;
use client_side::ClientSide;
pub use ending::is_over;
pub use entry::{Start, TrainOutcome, TrainRequest};
pub use error::{LastCheckpoint, TrainError};
use perturb_files::interrupt::StopFlag;
use perturb_policy::{Normalisers, Player, PlayerState};
use perturb_settings::TrainConfig;
pub use run_directory::{RunDirectory, RunDirectoryError, mark_in};
use server_side::ServerSide;
use trainer::Trainer;

use crate::checkpoint::{Checkpoint, ResumeState};
use crate::client::{Backoff, Reconnect, Servers};
use crate::logging::Progress;
use crate::policy::GradientWorkspace;

type Result<T> = std::result::Result<T, TrainError>;

/// Expected duration of an update above which connections are kept alive meanwhile. Servers drop a silent connection only
/// after some seconds.
const LONG_UPDATE: Duration = Duration::from_millis(100);

/// Trains as `config` says and writes logs and checkpoints to `directory`. Updates use `threads` threads, whose number
/// changes no byte. Calls `report` after every iteration. When `stop` is raised, the iteration is finished and the
/// checkpoint written. A lost server is [waited for](crate::client::ServerWait), and the training is resumed from its last
/// checkpoint, to the same bytes.
///
/// # Errors
/// A server that is lost for good, numbers that are not finite, a full disk. The last checkpoint in the directory stays as it is.
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

/// Resumes the run in `directory` from its last `checkpoint`, to the same bytes as without the break except times.
/// Otherwise as [`train`]. `servers` may be others than before. Lines of the logs beyond the checkpoint are deleted.
///
/// # Errors
/// The errors of [`train`]; an environment, a state or a log that does not fit the checkpoint, before anything is
/// changed.
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

/// Trains one run, and resumes it from its last checkpoint each time that servers were lost and have come back.
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

/// Trains several runs in one environment as [`train`] and [`resume`] do each alone, to the same bytes. Runs with short
/// rollouts share one session in lockstep. Runs with long rollouts get a session each, and the server acts. Runs with
/// observation noise always act in this process. `report` and `ended` get the run's place among `entries`. If a run fails,
/// the others go on.
///
/// # Errors
/// A session that cannot be opened, or a failure of the shared session, which ends all runs that have not ended yet. Their
/// last checkpoints stay as they are.
pub fn train_together(
    servers: &Servers,
    entries: Vec<TrainRequest<'_>>,
    threads: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
    ended: &mut dyn FnMut(usize, Result<TrainOutcome>),
) -> Result<()> {
    let is_random = |(_, entry): &(usize, TrainRequest<'_>)| entry.start.config().settings.is_random();
    let (random, entries): (Vec<_>, Vec<_>) = entries.into_iter().enumerate().partition(is_random);
    for (index, entry) in random {
        ended(index, random::make(servers, &entry));
    }
    let (mut server_side, runs, others) = ServerSide::open(servers, entries, threads, ended)?;
    train_loop(servers, &mut server_side, runs, stop, report, ended)?;
    if others.is_empty() {
        return Ok(());
    }
    let (mut client_side, runs) = ClientSide::open(servers, others, threads, ended)?;
    train_loop(servers, &mut client_side, runs, stop, report, ended)
}

/// A run in the training loop.
struct Run<'a> {
    /// The place among the runs that were begun together.
    index: usize,
    trainer: Trainer<'a>,
    /// Set when the run has ended.
    end: Option<Result<TrainOutcome>>,
}

impl Run<'_> {
    /// Ends the run if `result` is an error, and returns the value otherwise.
    ///
    /// # Errors
    /// An error of a server if the run's session `is_shared` with other runs, which it ends too.
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

/// A run whose rollout is whole.
struct Collected {
    /// The run's index.
    index: usize,
    /// Time spent on choosing actions in this process.
    acting: Duration,
    /// Time spent on waiting for servers.
    waiting: Duration,
}

/// A way to collect the rollouts of the runs of a loop. Runs are named by their index.
trait CollectRollouts {
    /// Collects until the rollout of at least one run is whole, or until a run has failed. Returns the runs with whole
    /// rollouts, in the order in which they should be updated.
    ///
    /// # Errors
    /// A failure that ends all runs. The failure of one run is stored in the run.
    fn collect(&mut self, runs: &mut [Run<'_>]) -> Result<Vec<Collected>>;

    /// The player of a run that acts in this process, to be given the new weights; `None` if the server acts.
    fn player(&mut self, index: usize) -> Option<&mut Player>;

    /// State and statistics of a run's player between two rollouts; `None` before the first.
    ///
    /// # Errors
    /// The failures of a connection.
    fn player_state(&mut self, index: usize) -> Result<Option<(PlayerState, Normalisers)>>;

    /// Snapshots of a run's environments between two rollouts.
    ///
    /// # Errors
    /// The failures of a connection.
    fn snapshots(&mut self, index: usize) -> Result<Vec<Bytes>>;

    /// Frees the environments of a run that has ended.
    ///
    /// # Errors
    /// The failures of a shared connection.
    fn release(&mut self, index: usize) -> Result<()>;

    /// Whether all runs share a session, so that the failure of its connection ends all of them.
    fn is_shared(&self) -> bool;
}

/// Trains `runs` until each has ended, and passes each run's outcome to `ended`.
///
/// # Errors
/// A failure of a shared session. Runs that have not ended by then can be resumed from their checkpoints.
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
        } // the last run's session is closed as a whole
    }
    Ok(())
}

/// Runs one iteration of the runs whose rollouts are whole first: collect, update, then log and save.
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
    updated.sort_by_key(|(index, _)| *index); // reports come in the order of runs, in whatever order these were updated
    for (index, progress) in updated {
        let Some(run) = find(runs, index) else { continue };
        report(index, &progress);
        let finished = finish_iteration(collector, run, progress, stop);
        run.store_error(finished, is_shared)?;
    }
    Ok(())
}

/// Logs an iteration of a run, and writes a checkpoint if one is due.
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

fn find<'r, 'a>(runs: &'r mut [Run<'a>], index: usize) -> Option<&'r mut Run<'a>> {
    runs.iter_mut().find(|run| run.index == index)
}

/// Runs `work` and keeps the connections alive meanwhile if it is `expected` to take long.
fn keep_alive<T>(servers: &Servers, expected: Duration, work: impl FnOnce() -> T) -> T {
    if expected < LONG_UPDATE { work() } else { servers.keep_alive_during(work) }
}
