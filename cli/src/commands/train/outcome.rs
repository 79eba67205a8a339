//! The messages at the end of `perturb train`.

use std::io::Write;
use std::process::ExitCode;

use perturb_learner::checkpoint::State;
use perturb_learner::logging::{EpisodeFigures, Progress, TimeShares};
use perturb_learner::training::{RunDirectory, TrainError, TrainOutcome};
use perturb_settings::TrainConfig;
use perturb_text::quoted;
use serde_json::json;

use super::super::args::TrainArgs;
use super::super::display::{note, output};
use super::super::error::Result;
use super::super::resume_hint::{resume_command, task_options, with_resume_command};
use super::super::signal_code;

/// Prints the end of a training and returns the exit status.
pub(super) fn finish(
    args: &TrainArgs,
    config: &TrainConfig,
    directory: &RunDirectory,
    outcome: Result<TrainOutcome, TrainError>,
) -> Result<ExitCode> {
    let outcome = match outcome {
        Ok(outcome) => outcome,
        Err(error) if error.signal().is_some() => {
            let signal = error.signal().unwrap_or_default();
            // If a signal ended the wait for a lost server, `source` is the server's error.
            let error = if let TrainError::Stopped { source, .. } = error { *source } else { error };
            let prefix = format!("stopped by signal {signal} while waiting for a server: ");
            let prefix = if error.signal().is_some() { "" } else { &prefix };
            note(format_args!("{prefix}{}", with_resume_command(error, &args.play)));
            return Ok(signal_code(signal));
        }
        Err(error) => return Err(with_resume_command(error, &args.play)),
    };
    if config.settings.learns() {
        summarise(&outcome.progress);
    }
    if let Some(number) = outcome.signal {
        note(format_args!(
            "stopped by signal {number} after {} of {} episodes; to go on with the training: {}",
            outcome.progress.episodes,
            config.common.episodes,
            resume_command(directory.path(), &args.play)
        ));
    }
    print_result(args, directory, &outcome.checkpoint.state, outcome.progress.recent, outcome.signal)?;
    Ok(outcome.signal.map_or(ExitCode::SUCCESS, signal_code))
}

/// Prints the path of the policy and writes the JSON result. `recent` has the means over the last 100 episodes.
pub(super) fn print_result(
    args: &TrainArgs,
    directory: &RunDirectory,
    state: &State,
    recent: Option<EpisodeFigures>,
    signal: Option<i32>,
) -> Result<()> {
    let TrainConfig { common, settings } = &state.config;
    args.json.write(json!({
        "run": directory.path().to_string_lossy(),
        "checkpoint": directory.checkpoint().to_string_lossy(),
        "environment": common.environment,
        "algorithm": settings.name(),
        "architecture": common.architecture,
        "train_version": common.version,
        "train_parameters": common.parameters,
        "train_contexts": common.contexts,
        "seed": common.seed,
        "training_episodes": state.counters.episodes,
        "training_steps": state.counters.timesteps,
        "budget": common.episodes,
        "finished": signal.is_none(),
        "last_100": recent.map(|EpisodeFigures { episode_return, length, success }| json!({
            "success_percent": 100.0 * success,
            "mean_return": episode_return,
            "mean_length": length,
        })),
    }))?;
    if signal.is_some() || args.json.is_printed() {
        return Ok(());
    }
    let mut out = output();
    writeln!(out, "trained policy: {}", directory.checkpoint().display())?;
    let tasks = task_options(&args.play.server);
    let command = format!("perturb evaluate --checkpoint {}{tasks}", quoted(directory.path()));
    Ok(writeln!(out, "test it: {command}")?)
}

/// Prints the number of episodes and steps, the means over the last 100 episodes, the speed, and the time shares.
fn summarise(progress: &Progress) {
    let TimeShares { acting, waiting, updating } = progress.percent();
    let recent = match progress.recent {
        Some(EpisodeFigures { episode_return, length, success }) => {
            format!("; the last 100: return {episode_return:.1}, length {length:.1}, success {:.1} %", 100.0 * success)
        }
        None => String::new(),
    };
    note(format_args!(
        "{} episodes, {} steps in {:.1} s{recent}",
        progress.episodes, progress.timesteps, progress.elapsed
    ));
    note(format_args!(
        "{:.0} steps/s: {acting:.0} % acting, {waiting:.0} % waiting for the server, {updating:.0} % updating",
        progress.fps()
    ));
}
