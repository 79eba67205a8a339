//! `perturb train --resume`: continues a training from its last checkpoint.

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
use super::outcome::{finish, print_result};

/// Maximum number of episodes in a budget, because TOML files store 64-bit signed integers.
const MAX_EPISODES: u64 = i64::MAX as u64;

/// Resumes the run in `path` from its last checkpoint.
pub(super) fn resume_run(args: &TrainArgs, path: &Path) -> Result<ExitCode> {
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let (directory, mut checkpoint, state) = RunDirectory::resume(path)?;
    recurrent::prepare(checkpoint.state.config.common.architecture, false)?;
    let trained = checkpoint.state.counters.episodes;
    if let Some(more) = args.extend {
        let budget = &mut checkpoint.state.config.common.episodes;
        *budget = extended_budget(*budget, trained, more);
    }
    let config = checkpoint.state.config.clone();
    let budget = config.common.episodes;
    if is_over(&config.common, &checkpoint.state.counters, state.history.recent.iter()) {
        let finished = format!("the training in {} is finished: it has {trained} of {budget} episodes", path.display());
        let rate = config.common.stop_at_success;
        match (trained < budget, args.extend) {
            (true, Some(_)) => {
                let message = format!("{finished} and stopped at {rate} % success, which --extend does not change");
                return Err(CommandError::Usage(message));
            }
            (true, None) => note(format_args!("{finished} and stopped at {rate} % success")),
            (false, _) => note(format_args!("{finished}; extend it with --extend EPISODES")),
        }
        let recent = EpisodeFigures::mean(state.history.recent.iter());
        print_result(args, &directory, &checkpoint.state, recent, None)?;
        return Ok(ExitCode::SUCCESS);
    }
    let suffix = if args.extend.is_some() { ", the new budget" } else { "" };
    note(format_args!("{config}: resuming after {trained} of {budget} episodes{suffix}"));
    let servers = playing_servers(&args.play, &stop)?;
    let mut display = Display::for_training(config.to_string(), &config, trained, checkpoint.state.counters.timesteps);
    let report = |progress: &Progress| display.training(progress);
    let outcome = resume(&servers, &directory, (checkpoint, state), threads(args.threads), &stop, report);
    drop(display);
    // Write the larger budget to config.toml only if the run has saved a checkpoint with it, so that both files agree.
    let saved = args.extend.and_then(|_| Checkpoint::load(path).ok());
    if saved.is_some_and(|saved| saved.state.config == config) {
        write_atomically(&path.join("config.toml"), config.to_toml().as_bytes())?;
    }
    finish(args, &config, &directory, outcome)
}

/// Returns the new budget: `more` episodes in addition to the old `budget` or to the `trained` episodes, whichever is
/// larger. The number of trained episodes may be larger, because a training finishes its last iteration.
fn extended_budget(budget: u64, trained: u64, more: u64) -> u64 {
    budget.max(trained).saturating_add(more).min(MAX_EPISODES)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_extended_from_the_finished_episodes() {
        assert_eq!(extended_budget(40, 25, 20), 60);
        assert_eq!(extended_budget(10, 44, 30), 74);
        assert_eq!(extended_budget(10, 44, u64::MAX), MAX_EPISODES);
    }
}
