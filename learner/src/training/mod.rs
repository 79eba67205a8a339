//! The training loop: rollout, update, log, checkpoint.
//!
//! Randomness: the environments' seed is the training's seed; initial weights, minibatch order and sampled actions have
//! streams of their own (see [`perturb_policy::random`]). Every sum has one order, so that equal configurations give equal
//! weights, byte for byte, whatever the number of servers, of their workers and of threads, wherever actions are chosen,
//! and whichever trainings run together.

mod ending;
mod error;
mod learning;
mod lockstep;
mod random;
mod remote;
mod run_directory;

use std::ops::Range;

use crate::checkpoint::{Checkpoint, ResumeState};
use crate::client::{After, OpenOptions, Servers, Session, Waiting};
use crate::logging::Progress;
use crate::rollout::{Collector, RemoteCollector};
pub use ending::is_over;
pub use error::{LastCheckpoint, TrainError};
use learning::Learning;
use lockstep::{Lockstep, Seat};
use perturb_policy::Player;
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::{Rollouts, TrainConfig};
use remote::Remote;
pub use run_directory::{RunDirectory, RunDirectoryError, mark_in};

type Result<T> = std::result::Result<T, TrainError>;

/// Environment steps of a reply to one of several trainings: some milliseconds of a classic task, a tenth of a second of a
/// robot. So none waits for long, however many there are.
const PIECE: usize = 4096;

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

/// A training that is to be begun, or gone on with.
#[derive(Debug)]
pub struct Entry<'a> {
    /// Where it is kept.
    pub directory: &'a RunDirectory,
    /// From where on.
    pub start: Start,
    /// Episodes of the budget, ascending, after which the policy of the moment is kept as well: [`RunDirectory::mark`].
    pub marks: &'a [u64],
}

/// Where a training begins.
#[derive(Clone, Debug)]
pub enum Start {
    /// At its beginning.
    Fresh(Box<TrainConfig>),
    /// At its last checkpoint.
    Checkpoint(Box<(Checkpoint, ResumeState)>),
}

impl Start {
    fn config(&self) -> &TrainConfig {
        match self {
            Self::Fresh(config) => config,
            Self::Checkpoint(saved) => &saved.0.state.config,
        }
    }

    /// Steps that are behind it.
    fn timesteps(&self) -> u64 {
        match self {
            Self::Fresh(_) => 0,
            Self::Checkpoint(saved) => saved.0.state.counters.timesteps,
        }
    }

    /// Where the training of `config` in `directory` goes on that was broken off.
    fn again(directory: &RunDirectory, config: &TrainConfig) -> Result<Self> {
        Ok(match directory.last_checkpoint()? {
            Some((mut checkpoint, state)) => {
                checkpoint.state.config = config.clone(); // a larger budget may not have been saved yet
                Self::Checkpoint(Box::new((checkpoint, state)))
            }
            None => Self::Fresh(Box::new(config.clone())),
        })
    }
}

/// Trains as `config` says, with `threads` threads in updates, which change no byte, and writes everything to `directory`;
/// calls `report` after every iteration. When `stop` is
/// raised, the iteration is finished and the checkpoint written. Servers that are lost are [waited
/// for](crate::client::ServerWait), and the training goes on from its last checkpoint, to the same bytes.
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
) -> Result<Outcome> {
    alone(
        servers,
        Entry { directory, start: Start::Fresh(Box::new(config.clone())), marks: &[] },
        threads,
        stop,
        report,
    )
}

/// Goes on with the run in `directory` from its last `checkpoint` to the same bytes as without the break, times aside;
/// otherwise as [`train`]. `servers` may be others than before. What the logs hold beyond the checkpoint is deleted.
///
/// # Errors
/// Those of [`train`]; an environment, a state or a log that does not fit the checkpoint, before anything is changed.
pub fn resume(
    servers: &Servers,
    directory: &RunDirectory,
    checkpoint: (Checkpoint, ResumeState),
    threads: usize,
    stop: &StopFlag,
    report: impl FnMut(&Progress),
) -> Result<Outcome> {
    let start = Start::Checkpoint(Box::new(checkpoint));
    alone(servers, Entry { directory, start, marks: &[] }, threads, stop, report)
}

/// Trains one policy, from its last checkpoint on when servers were lost and have come back.
fn alone(
    servers: &Servers,
    entry: Entry<'_>,
    threads: usize,
    stop: &StopFlag,
    mut report: impl FnMut(&Progress),
) -> Result<Outcome> {
    let Entry { directory, mut start, marks } = entry;
    let config = start.config().clone();
    let (mut waiting, mut saved) = (Waiting::default(), start.timesteps());
    loop {
        let mut hear = |progress: &Progress| {
            if progress.saved_timesteps > saved {
                saved = progress.saved_timesteps;
                waiting.progressed();
            }
            report(progress);
        };
        let error = match once(servers, Entry { directory, start, marks }, threads, stop, &mut hear) {
            Ok(outcome) => return Ok(outcome),
            Err(error) => error,
        };
        let Some(lost) = error.of_server() else { return Err(error) };
        match waiting.wait(servers, lost, stop) {
            After::Again => start = Start::again(directory, &config)?,
            After::GivenUp => return Err(error),
            After::Stopped { signal } => return Err(TrainError::Stopped { signal, source: Box::new(error) }),
        }
    }
}

/// Trains one policy while its servers are there.
fn once(
    servers: &Servers,
    entry: Entry<'_>,
    threads: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(&Progress),
) -> Result<Outcome> {
    let mut outcome = None;
    let mut ended = |_, end| outcome = Some(end);
    train_together(servers, vec![entry], threads, stop, &mut |_, progress| report(progress), &mut ended)?;
    outcome.unwrap_or_else(|| unreachable!("a training ends with an outcome or an error"))
}

/// Trains several policies in one environment as [`train`] and [`resume`] do each alone, to the same bytes: in lockstep over
/// one session, but for those with long rollouts where servers act, which have a session each. What adds noise to
/// observations acts here. `report` and `ended` are told the place among `entries`. One that fails ends; the others go on.
///
/// # Errors
/// Those of opening sessions, and the lockstep's, which ends all that have not ended yet; their last checkpoints stay as
/// they are.
pub fn train_together(
    servers: &Servers,
    entries: Vec<Entry<'_>>,
    threads: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
    ended: &mut dyn FnMut(usize, Result<Outcome>),
) -> Result<()> {
    let of_random = |(_, entry): &(usize, Entry<'_>)| entry.start.config().settings.is_random();
    let (random, entries): (Vec<_>, Vec<_>) = entries.into_iter().enumerate().partition(of_random);
    for (index, entry) in random {
        ended(index, random::make(servers, &entry));
    }
    let is_one = entries.len() == 1;
    let (mut remotes, mut in_lockstep) = (Vec::new(), Vec::new());
    for (index, entry) in entries {
        let config = entry.start.config();
        let rollouts = config.rollouts();
        if rollouts == Rollouts::Noisy || (!is_one && rollouts != Rollouts::Long) {
            in_lockstep.push((index, entry));
            continue;
        }
        let mut observations = Vec::new();
        let mut session = Session::open(servers, &learning::options(config), &mut observations)?;
        if !session.plays_together() {
            in_lockstep.push((index, entry));
            continue;
        }
        let slots = 0..session.num_envs();
        match sit_down(entry, &mut session, slots, &observations, threads) {
            Ok((learning, player)) => {
                let collector = RemoteCollector::new(learning.spec().clone(), player);
                let collector = if is_one { collector } else { collector.in_pieces(PIECE) };
                remotes.push(Remote::new(index, session, collector, learning));
            }
            Err(error) => ended(index, Err(error)),
        }
    }
    remote::run(servers, remotes, stop, report, ended)?;
    if in_lockstep.is_empty() { Ok(()) } else { lockstep(servers, in_lockstep, threads, stop, report, ended) }
}

/// Trains `entries`, at least one, each with its index, over one session.
fn lockstep(
    servers: &Servers,
    entries: Vec<(usize, Entry<'_>)>,
    threads: usize,
    stop: &StopFlag,
    report: &mut dyn FnMut(usize, &Progress),
    ended: &mut dyn FnMut(usize, Result<Outcome>),
) -> Result<()> {
    let options: Vec<OpenOptions> = entries.iter().map(|(_, entry)| learning::options(entry.start.config())).collect();
    let mut observations = Vec::new();
    let mut session = Session::open_together(servers, &options, &mut observations)?;
    let size = session.observation_size();
    let (mut seats, mut free) = (Vec::new(), Vec::new());
    let mut first = 0;
    for ((index, entry), options) in entries.into_iter().zip(&options) {
        let slots = first..first + options.num_envs;
        first = slots.end;
        let observations = &observations[slots.start * size..slots.end * size];
        match sit_down(entry, &mut session, slots.clone(), observations, threads) {
            Ok((learning, player)) => seats.push(Seat::new(index, slots, Collector::new(player), learning)),
            Err(error) => {
                free.push(slots);
                ended(index, Err(error));
            }
        }
    }
    let mut lockstep = Lockstep::new(session, seats)?;
    free.into_iter().rev().try_for_each(|slots| lockstep.release(slots))?;
    lockstep.run(servers, stop, report, ended)
}

/// Brings a training and its player to where they begin, in `slots` of the session.
fn sit_down<'a>(
    entry: Entry<'a>,
    session: &mut Session<'_>,
    slots: Range<usize>,
    observations: &[f32],
    threads: usize,
) -> Result<(Learning<'a>, Player)> {
    let environment = session.environment().clone();
    let Entry { directory, start, marks } = entry;
    let (mut learning, player) = match start {
        Start::Fresh(config) => Learning::begin(&config, directory, &environment, observations, threads)?,
        Start::Checkpoint(saved) => {
            let (checkpoint, state) = *saved;
            let restore = || {
                let restored = session.restore(slots, &state.collector.snapshots);
                restored.map(drop).map_err(|error| learning::not_restored("environments", error.into()))
            };
            Learning::resume((checkpoint, &state), directory, &environment, threads, restore)?
        }
    };
    learning.keep_at(marks);
    Ok((learning, player))
}
