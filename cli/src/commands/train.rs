//! `perturb train`.

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use toml::{Table, Value};

use super::args::TrainArgs;
use super::display::Display;
use super::error::{CommandError, Result, system};
use super::{playing_servers, sets, signal_code, threads};
use perturb_learner::logging::{EpisodeFigures, Progress, TimeShares};
use perturb_learner::training::{Outcome, RunDirectory, is_over, resume, train};
use perturb_study::Version;
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::{Common, TrainConfig};

pub(super) fn run(args: &TrainArgs) -> Result<ExitCode> {
    match (&args.resume, &args.out) {
        (Some(path), _) => go_on(args, path),
        (None, Some(path)) => begin(args, path),
        (None, None) => Err(CommandError::Usage("give --out DIR for a new run, or --resume DIR".into())),
    }
}

/// A new run in `out`.
fn begin(args: &TrainArgs, out: &Path) -> Result<ExitCode> {
    let config = TrainConfig::load(args.config.as_deref(), &args.set, flags(args)?)?;
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let directory = RunDirectory::choose(out, args.overwrite)?;
    let servers = playing_servers(&args.play)?;
    let environment = servers.environment_seen(&config.common)?; // its refusal lists the names
    perturb_study::sets::check("--parameters", &config.common.parameters, &environment)?;
    let mut display = Display::of_episodes(describe(&config), config.common.episodes);
    let outcome =
        train(&servers, &config, &directory, threads(args.threads), &stop, |progress| display.training(progress))?;
    drop(display);
    end(&config, &directory, &outcome)
}

/// The run in `path`, from its last checkpoint.
fn go_on(args: &TrainArgs, path: &Path) -> Result<ExitCode> {
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let (directory, checkpoint, state) = RunDirectory::resume(path)?;
    let config = checkpoint.state.config.clone();
    let (done, budget) = (checkpoint.state.counters.episodes, config.common.episodes);
    if is_over(&config.common, &checkpoint.state.counters, state.history.recent.iter()) {
        let enough = if done < budget { ", and stopped at its success rate" } else { "" };
        eprintln!("the training in {} is finished: it has {done} of {budget} episodes{enough}", path.display());
        print_policy(&directory)?;
        return Ok(ExitCode::SUCCESS);
    }
    eprintln!("{}: going on after {done} of {budget} episodes", describe(&config));
    let servers = playing_servers(&args.play)?;
    let mut display = Display::of_episodes(describe(&config), budget);
    let report = |progress: &Progress| display.training(progress);
    let outcome = resume(&servers, &directory, (checkpoint, state), threads(args.threads), &stop, report)?;
    drop(display);
    end(&config, &directory, &outcome)
}

/// Says what a training came to.
fn end(config: &TrainConfig, directory: &RunDirectory, outcome: &Outcome) -> Result<ExitCode> {
    if !config.settings.is_random() {
        summarise(&outcome.progress);
    }
    match outcome.signal {
        Some(number) => {
            eprintln!(
                "stopped by signal {number} after {} of {} episodes; go on with: perturb train --resume {}",
                outcome.progress.episodes,
                config.common.episodes,
                directory.path().display()
            );
            Ok(signal_code(number))
        }
        None => {
            print_policy(directory)?;
            Ok(ExitCode::SUCCESS)
        }
    }
}

fn print_policy(directory: &RunDirectory) -> std::io::Result<()> {
    let mut out = std::io::stdout();
    writeln!(out, "trained policy: {}", directory.checkpoint().display())?;
    writeln!(out, "test it: perturb evaluate --checkpoint {}", directory.path().display())
}

/// What is trained, in a few words.
pub(super) fn describe(config: &TrainConfig) -> String {
    let Common { environment, version, .. } = &config.common;
    format!("{environment} {version} {}", config.method())
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
    eprintln!("{} episodes, {} steps in {:.1} s{recent}", progress.episodes, progress.timesteps, progress.elapsed);
    eprintln!(
        "{:.0} steps/s: {acting:.0} % acting, {waiting:.0} % waiting for the server, {updating:.0} % updating",
        progress.fps()
    );
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
