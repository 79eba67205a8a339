//! `perturb heatmap`: draws the success of policies over two parameters.

mod experiment;

use std::io::Write;
use std::path::{Path, PathBuf};

use perturb_files::interrupt::StopFlag;
use perturb_files::{require_writable, write_atomically};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::evaluation::{heatmap, heatmap_again};
use perturb_learner::proto;
use perturb_protocol::{Distribution, Version, names};
use perturb_records::{Heatmap, HeatmapKind, HeatmapOptions, Records};
use perturb_report::{PolicyHeatmap, plot, policies_side_by_side};
use perturb_settings::sets::Context;
use perturb_settings::{Common, TrainConfig};

use super::args::HeatmapArgs;
use super::display::{Display, output};
use super::error::{CommandError, Result, system};
use super::{playing_servers, sets};

pub(super) fn run(args: &HeatmapArgs) -> Result<()> {
    match &args.dir {
        Some(directory) => experiment::run(args, directory),
        None => draw_checkpoints(args),
    }
}

/// Tests the policies of --checkpoint and draws their heatmaps side by side.
fn draw_checkpoints(args: &HeatmapArgs) -> Result<()> {
    let checkpoints = args.checkpoint.iter().map(|path| Checkpoint::load(path)).collect::<Result<Vec<_>, _>>()?;
    let name = one_environment(&args.checkpoint, &checkpoints)?;
    if let Some(twice) = (1..args.checkpoint.len()).find(|&i| args.checkpoint[..i].contains(&args.checkpoint[i])) {
        let path = args.checkpoint[twice].display();
        return Err(CommandError::Usage(format!("--checkpoint names {path} twice: give different policies")));
    }
    if !args.records.is_empty() && args.records.len() != checkpoints.len() {
        let files = args.records.len();
        let policies = checkpoints.len();
        let message = format!(
            "--records has {files} files for {policies} policies; give one file for each --checkpoint, in the same order"
        );
        return Err(CommandError::Usage(message));
    }
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = playing_servers(&args.play, &stop)?;
    let environment = servers.environment(&name)?;
    let mut kind = HeatmapKind { parameters: axes(args, &environment)?, base: args.base_version };
    let recorded = args.records.iter().map(|path| Records::read(path)).collect::<Result<Vec<_>, _>>()?;
    if let Some(base) = recorded.first().and_then(Heatmap::base_of) {
        kind.base = base;
    }
    let fixed = sets::normalize("--parameters", fixed_parameters(args)?, &environment)?;
    let path = args.out.clone().unwrap_or_else(|| default_path(&checkpoints, &kind));
    require_writable(&path.with_added_extension("csv")).map_err(|error| match args.out {
        Some(_) => error.into(),
        None => CommandError::Usage(format!("{error}; give another path with --out")),
    })?;
    let mut out = output();
    // Test each policy, or compute its heatmap from the recorded episodes of --records.
    let mut policies = Vec::new();
    for (index, checkpoint) in checkpoints.iter().enumerate() {
        let heatmap = if let Some(records) = recorded.get(index) {
            heatmap_again(&environment, checkpoint, records, &kind.parameters)?
        } else {
            let options = HeatmapOptions { fixed: fixed.clone(), ..options(args, &kind, &checkpoint.state.config) };
            let (heatmap, records) = test(&servers, checkpoint, &options, &stop)?;
            let extension = if checkpoints.len() > 1 { format!("{}.parquet", index + 1) } else { "parquet".into() };
            let path = path.with_added_extension(extension);
            records.write(&path)?;
            writeln!(out, "{}", path.display())?;
            heatmap
        };
        let config = &checkpoint.state.config;
        let method = config.method().to_string();
        let trained_on = config.common.trained_on();
        policies.push(PolicyHeatmap { method, trained_on, seed: config.common.seed, heatmap });
    }
    let (panels, figures) = policies_side_by_side(&policies).ok_or_else(|| {
        let message = "the files of --records have different points or numbers of episodes: give the files of one call";
        CommandError::Failed(message.into())
    })?;
    let svg = plot::svg(&panels)?.into_bytes();
    for (extension, content) in [("csv", figures.to_csv()), ("svg", svg), ("png", plot::png(&panels)?)] {
        let path = path.with_added_extension(extension);
        write_atomically(&path, &content)?;
        writeln!(out, "{}", path.display())?;
    }
    Ok(())
}

/// Returns the environment that all policies were trained in. Refuses policies of different environments.
fn one_environment(paths: &[PathBuf], checkpoints: &[Checkpoint]) -> Result<String> {
    let environment = |checkpoint: &Checkpoint| checkpoint.state.config.common.environment.clone();
    let named: Vec<(&Path, String)> =
        paths.iter().map(PathBuf::as_path).zip(checkpoints.iter().map(environment)).collect();
    let Some((first, name)) = named.first() else {
        return Err(CommandError::Usage("give the folder of an experiment, or --checkpoint".into()));
    };
    match named.iter().find(|(_, other)| other != name) {
        None => Ok(name.clone()),
        Some((path, other)) => Err(CommandError::Usage(format!(
            "{} was trained in {name}, {} in {other}: give policies of one environment",
            first.display(),
            path.display()
        ))),
    }
}

/// Returns the parameters on the x and y axis: those of --x and --y, or else the environment's default axes.
fn axes(args: &HeatmapArgs, environment: &proto::Environment) -> Result<[String; 2]> {
    if let (Some(x), Some(y)) = (&args.x, &args.y) {
        return Ok([axis(x, environment)?, axis(y, environment)?]);
    }
    environment.heatmap_axes.clone().try_into().map_err(|_| {
        let message = format!("give --x and --y: {} has no default axes", environment.name);
        CommandError::Usage(message)
    })
}

/// Returns the name of an environment's parameter. `written` may be in any case.
fn axis(written: &str, environment: &proto::Environment) -> Result<String> {
    let known = environment.parameters.iter().map(|parameter| parameter.name.as_str());
    names::find(written, known.clone()).map(|index| environment.parameters[index].name.clone()).ok_or_else(|| {
        let hint = names::did_you_mean(written, known.clone());
        let name = &environment.name;
        let known = known.collect::<Vec<_>>().join(", ");
        CommandError::Usage(format!("`{written}` cannot be an axis{hint}: give two of {name}'s parameters, {known}"))
    })
}

/// Returns the values of --parameters. Refuses more than one value of a parameter.
fn fixed_parameters(args: &HeatmapArgs) -> Result<Context> {
    let value = |(name, values): (String, Distribution)| match values.range() {
        (low, high) if low == high => Ok((name, low)),
        _ => {
            Err(CommandError::Usage(format!("--parameters {name} has more than one value; only --x and --y may vary")))
        }
    };
    sets::drawn_set(Version::D, &args.parameters)?.drawn().into_iter().map(value).collect()
}

/// Returns the default path of the files, without extension. It is in the working directory, and not in the training's
/// folder, which holds only files of the training.
fn default_path(checkpoints: &[Checkpoint], kind: &HeatmapKind) -> PathBuf {
    let TrainConfig { common, settings } = &checkpoints[0].state.config;
    let Common { environment, architecture, version, parameters, seed, .. } = common;
    if checkpoints.len() > 1 {
        return format!("{environment}-{}-policies-{kind}", checkpoints.len()).into();
    }
    let suffix = if parameters.is_empty() { "" } else { "-own" };
    let version = version.file_name();
    format!("{environment}-{}-{architecture}-{version}{suffix}-s{seed}-{kind}", settings.name()).into()
}

/// Returns the options for testing a policy that was trained with the settings `trained`.
fn options(args: &HeatmapArgs, kind: &HeatmapKind, trained: &TrainConfig) -> HeatmapOptions {
    HeatmapOptions {
        parameters: kind.parameters.clone(),
        base: kind.base,
        grid: args.grid,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(trained.common.seed),
        fixed: Context::new(),
    }
}

fn test(
    servers: &Servers,
    checkpoint: &Checkpoint,
    options: &HeatmapOptions,
    stop: &StopFlag,
) -> Result<(Heatmap, Records)> {
    let [x, y] = &options.parameters;
    let mut display = Display::for_episodes(format!("testing over {x} and {y}"), options.total_episodes()?);
    Ok(heatmap(servers, checkpoint, options, stop, &mut |episodes| display.episodes(episodes))?)
}
