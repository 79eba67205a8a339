//! `perturb train`.

mod outcome;
mod resume;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use perturb_experiment::runs::Kind;
use perturb_files::interrupt::StopFlag;
use perturb_files::{create_folder, io};
use perturb_learner::logging::Progress;
use perturb_learner::training::{RunDirectory, train};
use perturb_protocol::Version;
use perturb_settings::TrainConfig;
use toml::{Table, Value};

use super::args::TrainArgs;
use super::display::Display;
use super::error::{CommandError, Result, system};
use super::{playing_servers, recurrent, refuse_file, require_file, sets, threads};

pub(super) fn run(args: &TrainArgs) -> Result<ExitCode> {
    args.json.check()?;
    match &args.resume {
        Some(path) => resume::go_on(args, path),
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
    perturb_settings::sets::check("--parameters", &config.common.parameters, &environment)?;
    let directory = match chosen {
        Some(directory) => directory,
        None => RunDirectory::choose(&usual_directory(&config)?, false)?,
    };
    let mut display = Display::of_training(config.to_string(), &config, 0, 0);
    let report = |progress: &Progress| display.training(progress);
    let outcome = train(&servers, &config, &directory, threads(args.threads), &stop, report);
    drop(display);
    outcome::end(args, &config, &directory, outcome)
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
