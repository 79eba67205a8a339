//! `perturb train`: trains a policy.

mod outcome;
mod resume;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use perturb_experiment::runs::RunKind;
use perturb_files::interrupt::StopFlag;
use perturb_files::{create_folder, io};
use perturb_learner::logging::Progress;
use perturb_learner::training::{RunDirectory, train};
use perturb_protocol::Version;
use perturb_settings::TrainConfig;
use perturb_settings::sets::Contexts;
use toml::{Table, Value};

use super::args::TrainArgs;
use super::display::Display;
use super::error::{CommandError, Result, system};
use super::{playing_servers, recurrent, refuse_file, require_default_out, require_file, sets, threads};

pub(super) fn run(args: &TrainArgs) -> Result<ExitCode> {
    args.json.check()?;
    match &args.resume {
        Some(path) => resume::resume_run(args, path),
        None => begin_run(args),
    }
}

/// Begins a new training.
fn begin_run(args: &TrainArgs) -> Result<ExitCode> {
    if args.extend.is_some() {
        let message = "--extend is for an existing run: give --resume DIR with it, or --episodes for a new run";
        return Err(CommandError::Usage(message.into()));
    }
    let remedy = "give a TOML file of settings, e.g. the config.toml of an earlier run";
    args.config.iter().try_for_each(|path| require_file(path, remedy))?;
    let mut config = TrainConfig::load(args.config.as_deref(), &args.set, flags(args)?)?;
    recurrent::prepare(config.common.architecture, false)?;
    args.out.iter().try_for_each(|out| refuse_file(out))?;
    if let Some(out) = args.out.as_deref().filter(|out| RunKind::detect(out) == Some(RunKind::Experiment)) {
        let message = format!("--out {} holds an experiment (plan.toml): choose another directory", out.display());
        return Err(CommandError::Usage(message));
    }
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let given_directory = args.out.as_deref().map(|out| RunDirectory::choose(out, args.overwrite)).transpose()?;
    let servers = playing_servers(&args.play, &stop)?;
    let environment = servers.environment_seen(&config.common)?;
    config.common.environment = environment.name.clone();
    let option = if config.common.contexts.is_empty() { "--parameters" } else { "--contexts" };
    let set = sets::normalize_set(config.common.training_set(option), &environment)?;
    set.check(&environment)?;
    match set.contexts {
        Contexts::Drawn(parameters) => config.common.parameters = parameters,
        Contexts::Listed(contexts) => config.common.contexts = contexts,
    }
    let directory = match given_directory {
        Some(directory) => directory,
        None => RunDirectory::choose(&create_default_directory(&config)?, false)?,
    };
    let mut display = Display::for_training(config.to_string(), &config, 0, 0);
    let report = |progress: &Progress| display.training(progress);
    let outcome = train(&servers, &config, &directory, threads(args.threads), &stop, report);
    drop(display);
    outcome::finish(args, &config, &directory, outcome)
}

/// Creates the folder of a training without --out. Trainings that begin in the same second get different folders.
fn create_default_directory(config: &TrainConfig) -> Result<PathBuf> {
    let runs = Path::new("runs");
    require_default_out(runs)?;
    create_folder(runs)?;
    let time = chrono::Utc::now().format("%Y%m%d-%H%M%S");
    let name = format!("{}-{}-{time}", config.common.environment, config.settings.name());
    let names = std::iter::once(name.clone()).chain((2..).map(|count: u32| format!("{name}-{count}")));
    for path in names.map(|name| runs.join(name)) {
        match std::fs::create_dir(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            created => return Ok(created.map(|()| path.clone()).map_err(io("create", &path))?),
        }
    }
    unreachable!("there is a number for each run")
}

/// Returns the settings that are given by options.
fn flags(args: &TrainArgs) -> Result<Table> {
    let text = |value: &Option<String>| value.clone().map(Value::String);
    let number = |name: &str, value: Option<u64>| {
        let refuse = |value| CommandError::Usage(format!("--{name} {value} is too large: the maximum is {}", i64::MAX));
        value.map(|value| i64::try_from(value).map(Value::Integer).map_err(|_| refuse(value))).transpose()
    };
    let version = args.version.unwrap_or(Version::D);
    let parameters = sets::drawn_set(version, &args.parameters)?.drawn();
    let parameters = Table::try_from(parameters).map_err(|error| CommandError::Usage(error.to_string()))?;
    let set = args.contexts.as_deref().map(|path| sets::listed_set(version, path)).transpose()?;
    let contexts = set.map(|set| Value::try_from(set.listed())).transpose();
    let contexts = contexts.map_err(|error| CommandError::Usage(error.to_string()))?;
    let settings = [
        ("environment", text(&args.env)),
        ("version", text(&args.version.map(|version| version.to_string()))),
        ("parameters", (!parameters.is_empty()).then_some(Value::Table(parameters))),
        ("contexts", contexts),
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
