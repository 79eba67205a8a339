//! `perturb train --resume`.

use std::path::Path;
use std::process::ExitCode;

use perturb_files::interrupt::StopFlag;
use perturb_files::write_atomically;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::logging::{EpisodeFigures, Progress};
use perturb_learner::training::{RunDirectory, is_over, resume};

use super::super::args::TrainArgs;
use super::super::display::{Display, note};
use super::super::error::{CommandError, Result, system};
use super::super::{playing_servers, recurrent, threads};
use super::outcome::{end, say};

/// What a TOML file can hold.
const MAX_EPISODES: u64 = i64::MAX as u64;

/// The run in `path`, from its last checkpoint.
pub(super) fn go_on(args: &TrainArgs, path: &Path) -> Result<ExitCode> {
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let (directory, mut checkpoint, state) = RunDirectory::resume(path)?;
    recurrent::prepare(checkpoint.state.config.common.architecture, false)?;
    let done = checkpoint.state.counters.episodes;
    if let Some(more) = args.extend {
        let budget = &mut checkpoint.state.config.common.episodes;
        *budget = extended(*budget, done, more);
    }
    let config = checkpoint.state.config.clone();
    let budget = config.common.episodes;
    if is_over(&config.common, &checkpoint.state.counters, state.history.recent.iter()) {
        let finished = format!("the training in {} is finished: it has {done} of {budget} episodes", path.display());
        let rate = config.common.stop_at_success;
        match (done < budget, args.extend) {
            (true, Some(_)) => {
                let message = format!("{finished}, and stopped at {rate} % success, which --extend does not change");
                return Err(CommandError::Usage(message));
            }
            (true, None) => note(format_args!("{finished}, and stopped at {rate} % success")),
            (false, _) => note(format_args!("{finished}; train on with --extend EPISODES")),
        }
        let recent = EpisodeFigures::mean(state.history.recent.iter());
        say(args, &directory, &checkpoint.state, recent, None)?;
        return Ok(ExitCode::SUCCESS);
    }
    let new = if args.extend.is_some() { ", the new budget" } else { "" };
    note(format_args!("{config}: going on after {done} of {budget} episodes{new}"));
    let servers = playing_servers(&args.play)?;
    let mut display = Display::of_training(config.to_string(), &config, done, checkpoint.state.counters.timesteps);
    let report = |progress: &Progress| display.training(progress);
    let outcome = resume(&servers, &directory, (checkpoint, state), threads(args.threads), &stop, report);
    drop(display);
    // The budget is the larger one as soon as a checkpoint has it.
    let saved = args.extend.and_then(|_| Checkpoint::load(path).ok());
    if saved.is_some_and(|saved| saved.state.config == config) {
        write_atomically(&path.join("config.toml"), config.to_toml().as_bytes())?;
    }
    end(args, &config, &directory, outcome)
}

/// The budget after `more` episodes beyond the one before, or beyond those that are done: the last iteration goes past it.
fn extended(budget: u64, done: u64, more: u64) -> u64 {
    budget.max(done).saturating_add(more).min(MAX_EPISODES)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_extended_from_itself_or_from_what_is_done_beyond_it() {
        assert_eq!(extended(40, 25, 20), 60);
        assert_eq!(extended(10, 44, 30), 74);
        assert_eq!(extended(10, 44, u64::MAX), MAX_EPISODES);
    }
}
