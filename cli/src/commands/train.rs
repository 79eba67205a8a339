//! `perturb train`.

use std::io::Write;
use std::path::Path;

use toml::{Table, Value};

use super::args::TrainArgs;
use super::display::Display;
use super::error::{CommandError, Result, system};
use super::{Ending, servers, sets};
use perturb_learner::logging::{EpisodeFigures, Progress, TimeShares};
use perturb_learner::training::{Outcome, RunDirectory, resume, train};
use perturb_study::Version;
use perturb_study::interrupt::StopFlag;
use perturb_study::settings::{Sources, TrainConfig};

pub(super) fn run(args: &TrainArgs) -> Result<Ending> {
    match (&args.resume, &args.out) {
        (Some(path), _) => go_on(args, path),
        (None, Some(path)) => begin(args, path),
        (None, None) => Err(CommandError::Usage("give --out DIR for a new run, or --resume DIR".into())),
    }
}

/// A new run in `out`.
fn begin(args: &TrainArgs, out: &Path) -> Result<Ending> {
    let flags = flags(args)?;
    let config = TrainConfig::load(&Sources { file: args.config.as_deref(), sets: &args.set, flags })?;
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let directory = RunDirectory::choose(out, args.overwrite)?;
    let servers = servers(&args.server)?;
    let environment = servers.environment(&config.common.environment)?; // its refusal lists the names
    perturb_study::sets::check("--parameters", &config.common.parameters, &environment)?;
    let mut display = Display::of_episodes(describe(&config), config.common.episodes);
    let outcome = train(&servers, &config, &directory, &stop, |progress| display.training(progress))?;
    drop(display);
    end(&config, &directory, &outcome)
}

/// The run in `path`, from its last checkpoint.
fn go_on(args: &TrainArgs, path: &Path) -> Result<Ending> {
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let (directory, checkpoint, state) = RunDirectory::resume(path)?;
    let config = checkpoint.state.config.clone();
    let (done, budget) = (checkpoint.state.counters.episodes, config.common.episodes);
    if done >= budget {
        eprintln!("the training in {} is finished: it has {done} of {budget} episodes", path.display());
        print_policy(&directory)?;
        return Ok(Ending::Done);
    }
    eprintln!("{}: going on after {done} of {budget} episodes", describe(&config));
    let servers = servers(&args.server)?;
    let mut display = Display::of_episodes(describe(&config), budget);
    let report = |progress: &Progress| display.training(progress);
    let outcome = resume(&servers, &directory, (checkpoint, state), &stop, report)?;
    drop(display);
    end(&config, &directory, &outcome)
}

/// Says what a training came to.
fn end(config: &TrainConfig, directory: &RunDirectory, outcome: &Outcome) -> Result<Ending> {
    summarise(&outcome.progress);
    match outcome.signal {
        Some(number) => {
            eprintln!(
                "stopped by signal {number} after {} of {} episodes; go on with: perturb train --resume {}",
                outcome.progress.episodes,
                config.common.episodes,
                directory.path().display()
            );
            Ok(Ending::Signal(number))
        }
        None => {
            print_policy(directory)?;
            Ok(Ending::Done)
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
    let common = &config.common;
    format!("{} {} {} {}", common.environment, common.version, config.settings.name(), common.architecture)
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
    let number = |name: &str, value: u64| {
        let refuse = |_| CommandError::Usage(format!("--{name} {value} is too large: the most is {}", i64::MAX));
        i64::try_from(value).map(Value::Integer).map_err(refuse)
    };
    let mut table = Table::new();
    let mut text = |key: &str, value: Option<String>| {
        value.map(|value| table.insert(key.to_owned(), Value::String(value)));
    };
    text("environment", args.env.clone());
    text("version", args.version.map(|version| version.to_string()));
    text("algorithm", args.algorithm.clone());
    text("architecture", args.architecture.clone());
    if !args.parameters.is_empty() {
        let set = sets::drawn(args.version.unwrap_or(Version::D), &args.parameters)?;
        let parameters = Table::try_from(set.drawn()).map_err(|error| CommandError::Usage(error.to_string()))?;
        table.insert("parameters".into(), Value::Table(parameters));
    }
    for (flag, value) in
        [("episodes", args.episodes), ("seed", args.seed), ("episodes-per-trial", args.episodes_per_trial)]
    {
        if let Some(value) = value {
            table.insert(flag.replace('-', "_"), number(flag, value)?);
        }
    }
    Ok(table)
}
