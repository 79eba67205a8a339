//! `perturb train`.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use serde_json::json;
use toml::{Table, Value};

use super::again::{explain, resume_command};
use super::args::TrainArgs;
use super::display::{Display, note};
use super::error::{CommandError, Result, system};
use super::{playing_servers, recurrent, refuse_file, require_file, sets, signal_code, threads};
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::logging::{EpisodeFigures, Progress, TimeShares};
use perturb_learner::training::{Outcome, RunDirectory, TrainError, is_over, resume, train};
use perturb_study::Version;
use perturb_study::files::{create_folder, io, write_atomically};
use perturb_study::interrupt::StopFlag;
use perturb_study::runs::Kind;
use perturb_study::settings::TrainConfig;
use perturb_study::words::quoted;

/// What a TOML file can hold.
const MOST_EPISODES: u64 = i64::MAX as u64;

pub(super) fn run(args: &TrainArgs) -> Result<ExitCode> {
    args.json.check()?;
    match &args.resume {
        Some(path) => go_on(args, path),
        None => begin(args),
    }
}

/// A new run.
fn begin(args: &TrainArgs) -> Result<ExitCode> {
    if args.extend.is_some() {
        let message = "--extend is for a run that is there: give --resume DIR with it, or --episodes for a new one";
        return Err(CommandError::Usage(message.into()));
    }
    let remedy = "give a TOML file of settings, e.g. the config.toml of an earlier run";
    args.config.iter().try_for_each(|path| require_file(path, remedy))?;
    let mut config = TrainConfig::load(args.config.as_deref(), &args.set, flags(args)?)?;
    recurrent::prepare(config.common.architecture, false)?;
    args.out.iter().try_for_each(|out| refuse_file(out))?;
    if let Some(out) = args.out.as_deref().filter(|out| Kind::of(out) == Some(Kind::Experiment)) {
        let message = format!("--out {} holds an experiment (plan.toml): choose another directory", out.display());
        return Err(CommandError::Usage(message));
    }
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let chosen = args.out.as_deref().map(|out| RunDirectory::choose(out, args.overwrite)).transpose()?;
    let servers = playing_servers(&args.play)?;
    let environment = servers.environment_seen(&config.common)?; // its refusal lists the names
    config.common.environment = environment.name.clone(); // however it was spelled
    config.common.parameters =
        sets::spelled("--parameters", std::mem::take(&mut config.common.parameters), &environment)?;
    perturb_study::sets::check("--parameters", &config.common.parameters, &environment)?;
    let directory = match chosen {
        Some(directory) => directory,
        None => RunDirectory::choose(&usual_directory(&config)?, false)?,
    };
    let mut display = Display::of_training(config.to_string(), &config, 0, 0);
    let report = |progress: &Progress| display.training(progress);
    let outcome = train(&servers, &config, &directory, threads(args.threads), &stop, report);
    drop(display);
    end(args, &config, &directory, outcome)
}

/// The run in `path`, from its last checkpoint.
fn go_on(args: &TrainArgs, path: &Path) -> Result<ExitCode> {
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
    budget.max(done).saturating_add(more).min(MOST_EPISODES)
}

/// Says what a training came to.
fn end(
    args: &TrainArgs,
    config: &TrainConfig,
    directory: &RunDirectory,
    outcome: Result<Outcome, TrainError>,
) -> Result<ExitCode> {
    let outcome = match outcome {
        Ok(outcome) => outcome,
        Err(TrainError::Stopped { signal, source }) => {
            let lost = explain(*source, &args.play);
            note(format_args!("stopped by signal {signal}, waiting for a server: {lost}"));
            return Ok(signal_code(signal));
        }
        Err(error) => return Err(explain(error, &args.play)),
    };
    if !config.settings.is_random() {
        summarise(&outcome.progress);
    }
    if let Some(number) = outcome.signal {
        note(format_args!(
            "stopped by signal {number} after {} of {} episodes; go on with: {}",
            outcome.progress.episodes,
            config.common.episodes,
            resume_command(directory.path(), &args.play)
        ));
    }
    say(args, directory, &outcome.checkpoint.state, outcome.progress.recent, outcome.signal)?;
    Ok(outcome.signal.map_or(ExitCode::SUCCESS, signal_code))
}

/// Says where the policy is and, as JSON, what it is; `recent` are the means over the last 100 episodes.
fn say(
    args: &TrainArgs,
    directory: &RunDirectory,
    state: &State,
    recent: Option<EpisodeFigures>,
    signal: Option<i32>,
) -> Result<()> {
    let TrainConfig { common, settings } = &state.config;
    args.json.write(json!({
        "run": directory.path(),
        "checkpoint": directory.checkpoint(),
        "environment": common.environment,
        "algorithm": settings.name(),
        "architecture": common.architecture,
        "train_version": common.version,
        "train_parameters": common.parameters,
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
    let mut out = std::io::stdout();
    writeln!(out, "trained policy: {}", directory.checkpoint().display())?;
    let command = format!("perturb evaluate --checkpoint {}", quoted(directory.path()));
    Ok(writeln!(out, "test it: {command}")?)
}

/// Makes the folder of a run that nobody gave a place: another one for each, also of those that begin in the same second.
fn usual_directory(config: &TrainConfig) -> Result<PathBuf> {
    let runs = Path::new("runs");
    create_folder(runs)?;
    let time = chrono::Utc::now().format("%Y%m%d-%H%M%S");
    let name = format!("{}-{}-{time}", config.common.environment, config.settings.name());
    let names = std::iter::once(name.clone()).chain((2..).map(|count: u32| format!("{name}-{count}")));
    for path in names.map(|name| runs.join(name)) {
        match std::fs::create_dir(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            made => return Ok(made.map(|()| path.clone()).map_err(io("create", &path))?),
        }
    }
    unreachable!("there is a number for each run")
}

/// A line of figures, with the shares of the time.
pub(super) fn summarise(progress: &Progress) {
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

/// The settings among the flags.
fn flags(args: &TrainArgs) -> Result<Table> {
    let text = |value: &Option<String>| value.clone().map(Value::String);
    let number = |name: &str, value: Option<u64>| {
        let refuse = |value| CommandError::Usage(format!("--{name} {value} is too large: the most is {}", i64::MAX));
        value.map(|value| i64::try_from(value).map(Value::Integer).map_err(|_| refuse(value))).transpose()
    };
    let own = sets::drawn(args.version.unwrap_or(Version::D), &args.parameters)?.drawn();
    let own = Table::try_from(own).map_err(|error| CommandError::Usage(error.to_string()))?;
    let settings = [
        ("environment", text(&args.env)),
        ("version", text(&args.version.map(|version| version.to_string()))),
        ("parameters", (!own.is_empty()).then_some(Value::Table(own))),
        ("preset", text(&args.preset)),
        ("algorithm", text(&args.algorithm)),
        ("architecture", text(&args.architecture)),
        ("observe", text(&args.observe)),
        ("episodes", number("episodes", args.episodes)?),
        ("seed", number("seed", args.seed)?),
        ("episodes_per_trial", number("episodes-per-trial", args.episodes_per_trial)?),
    ];
    Ok(settings.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_extended_from_itself_or_from_what_is_done_beyond_it() {
        assert_eq!(extended(40, 25, 20), 60);
        assert_eq!(extended(10, 44, 30), 74);
        assert_eq!(extended(10, 44, u64::MAX), MOST_EPISODES);
    }
}
