//! `perturb heatmap`.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::args::HeatmapArgs;
use super::display::Display;
use super::error::{CommandError, Result, system};
use super::{plan_in, playing_servers, sets};
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::client::Servers;
use perturb_learner::evaluation::{heatmap, heatmap_again};
use perturb_learner::proto;
use perturb_protocol::{Distribution, Version};
use perturb_study::files::write_atomically;
use perturb_study::interrupt::StopFlag;
use perturb_study::records::Records;
use perturb_study::sets::Context;
use perturb_study::settings::{Common, TrainConfig};
use perturb_study::{
    Folder, Heatmap, HeatmapOptions, NoHeatmap, Results, Selected, heatmap_files, heatmap_places, store_heatmap,
};

pub(super) fn run(args: &HeatmapArgs) -> Result<()> {
    match (&args.dir, &args.checkpoint) {
        (Some(directory), _) => of_experiment(args, directory),
        (None, Some(checkpoint)) => of_checkpoint(args, checkpoint),
        (None, None) => Err(CommandError::Usage("give the directory of an experiment, or --checkpoint".into())),
    }
}

/// Of one policy.
fn of_checkpoint(args: &HeatmapArgs, path: &Path) -> Result<()> {
    let checkpoint = Checkpoint::load(path)?;
    let state = &checkpoint.state;
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = playing_servers(&args.play)?;
    let environment = servers.environment(&state.config.common.environment)?;
    let parameters = match (&args.x, &args.y) {
        (Some(x), Some(y)) => [x.clone(), y.clone()],
        _ => usual_axes(&environment).ok_or_else(|| {
            let message = format!("give --x and --y: it is not known which of {}'s to show", environment.name);
            CommandError::Usage(message)
        })?,
    };
    let options = HeatmapOptions { fixed: fixed(args)?, ..options(args, parameters, state) };
    let (heatmap, records) = match &args.records {
        None => {
            let (heatmap, records) = test(&servers, &checkpoint, &options, &stop)?;
            (heatmap, Some(records))
        }
        Some(path) => (heatmap_again(&environment, &checkpoint, &Records::read(path)?, &options.parameters)?, None),
    };
    let path = args.out.clone().unwrap_or_else(|| default_path(state, &options.parameters));
    let mut out = std::io::stdout();
    if let Some(records) = records {
        let path = path.with_added_extension("parquet");
        records.write(&path)?;
        writeln!(out, "{}", path.display())?;
    }
    for (ending, content) in heatmap_files(&heatmap)? {
        let path = path.with_added_extension(ending);
        write_atomically(&path, &content)?;
        writeln!(out, "{}", path.display())?;
    }
    Ok(())
}

/// The two parameters over which an environment's heatmaps are unless others are asked for.
fn usual_axes(environment: &proto::Environment) -> Option<[String; 2]> {
    environment.heatmap_axes.clone().try_into().ok()
}

/// The values of other parameters.
fn fixed(args: &HeatmapArgs) -> Result<Context> {
    let value = |(name, values): (String, Distribution)| match values.range() {
        (low, high) if low == high => Ok((name, low)),
        _ => Err(CommandError::Usage(format!(
            "--parameters {name} has more than one value; --x and --y are what varies"
        ))),
    };
    sets::drawn(Version::D, &args.parameters)?.drawn().into_iter().map(value).collect()
}

/// In the working directory: a training's folder has nothing in it that its training did not write.
fn default_path(state: &State, [x, y]: &[String; 2]) -> PathBuf {
    let TrainConfig { common: Common { environment, architecture, version, parameters, seed, .. }, settings } =
        &state.config;
    let own = if parameters.is_empty() { "" } else { "-own" };
    format!("{environment}-{}-{architecture}-{version}{own}-s{seed}-{x}-{y}", settings.name()).into()
}

/// Of everything that was selected in the first run of an experiment, unless it is there already.
fn of_experiment(args: &HeatmapArgs, directory: &Path) -> Result<()> {
    let folder = Folder::new(directory);
    let plan = plan_in(&folder)?;
    let results = Results::read(&plan, &folder)?;
    let selections = results.select();
    let places = heatmap_places(&selections);
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let mut servers_of_all = None;
    let mut out = std::io::stdout();
    let mut failed = 0;
    for place in &places {
        let Some(selected) = place.selected else {
            eprintln!("{place}: {}", NoHeatmap::NoResult);
            continue;
        };
        let servers = match &mut servers_of_all {
            Some(servers) => servers,
            none => none.insert(playing_servers(&args.play)?),
        };
        let Some(parameters) = usual_axes(&servers.environment(place.environment)?) else {
            eprintln!("{place}: it is not known which parameters to show");
            continue;
        };
        let checkpoint = match checkpoint_of(&folder, selected) {
            Ok(checkpoint) => checkpoint,
            Err(error) => {
                eprintln!("{place}: {error}");
                failed += 1;
                continue;
            }
        };
        let options = options(args, parameters, &checkpoint.state);
        if place.read(&folder)?.is_ok_and(|heatmap| heatmap.record.options == options) {
            eprintln!("{place}: is there already");
            continue;
        }
        let (heatmap, records) = test(servers, &checkpoint, &options, &stop)
            .map_err(|error| CommandError::Place { place: place.to_string(), source: Box::new(error) })?;
        let id = checkpoint.id().map_err(|reason| CommandError::Failed(format!("{place}: {reason}")))?;
        // Before the heatmap, whose record is what tells that it is complete.
        records.write(&folder.path().join("heatmaps").join(format!("{}.parquet", selected.cell.id)))?;
        let path = store_heatmap(&folder, selected.cell, id, options, &heatmap)?;
        writeln!(out, "{}.png, .svg and .csv", path.display())?;
    }
    if failed > 0 {
        return Err(CommandError::Failed(format!("{failed} of {} heatmaps could not be made", places.len())));
    }
    Ok(())
}

/// The checkpoint that a result comes from.
fn checkpoint_of(folder: &Folder, Selected { cell, result }: Selected<'_>) -> Result<Checkpoint> {
    let checkpoint = Checkpoint::load(&folder.cell(&cell.id).training())?;
    let (state, training) = (&checkpoint.state, &result.training);
    if training.settings != state.config.table() || training.counters != state.counters {
        let message = format!("the checkpoint of {} is not the one that its result.json came from", cell.id);
        return Err(CommandError::Failed(message));
    }
    Ok(checkpoint)
}

fn options(args: &HeatmapArgs, parameters: [String; 2], state: &State) -> HeatmapOptions {
    HeatmapOptions {
        parameters,
        grid: args.grid,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(state.config.common.seed),
        fixed: Context::new(),
    }
}

fn test(
    servers: &Servers,
    checkpoint: &Checkpoint,
    options: &HeatmapOptions,
    stop: &StopFlag,
) -> Result<(Heatmap, Records)> {
    let HeatmapOptions { parameters: [x, y], grid, episodes, .. } = options;
    let mut display = Display::of_episodes(format!("testing over {x} and {y}"), (grid * grid) as u64 * episodes);
    Ok(heatmap(servers, checkpoint, options, stop, &mut |episodes| display.episodes(episodes))?)
}
