//! Heatmaps of the policies that an experiment selected.

use std::io::Write;
use std::path::Path;

use perturb_experiment::{
    ExperimentFolder, HeatmapPlace, NoHeatmap, Results, Selected, heatmap_path, heatmap_places, store_heatmap,
};
use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::proto;
use perturb_protocol::names;
use perturb_records::HeatmapKind;
use perturb_report::{heatmap_pictures, save_heatmaps};

use super::{axes, options, test};
use crate::commands::args::{HeatmapArgs, PlayArgs};
use crate::commands::display::{note, output, say};
use crate::commands::error::{CommandError, Result, system};
use crate::commands::{plan_in, playing_servers, refuse_file, require_default_out, with_tasks_of};

/// Counts for the command's exit status.
#[derive(Default)]
struct HeatmapCounts {
    /// Number of heatmaps to make: one for each selected policy whose environment has the parameters of both axes.
    total: usize,
    /// Number of heatmaps in `total` that could not be made.
    failed: usize,
    /// Number of environments that are skipped because they lack the parameter of an axis, or have no default axes.
    skipped_environments: usize,
}

/// Tests the selected policies that have no heatmap yet, and draws the heatmaps of all selected policies.
pub(super) fn run(args: &HeatmapArgs, directory: &Path) -> Result<()> {
    let mut folder = ExperimentFolder::new(directory);
    let plan = plan_in(&folder)?;
    let report = match &args.out {
        Some(out) => {
            refuse_file(out)?;
            folder = folder.with_new_heatmaps(out.join("heatmaps"));
            out.clone()
        }
        None => {
            require_default_out(directory)?;
            directory.join("report")
        }
    };
    // A `HeatmapPlace` stands for the heatmaps of one policy: the policy that was selected for an environment, a
    // method, a training set and a run.
    let results = Results::read(&plan, &folder)?;
    let selections = results.select();
    let places = heatmap_places(&selections);
    let selected: Vec<&HeatmapPlace<'_>> =
        places.iter().filter(|place| args.runs.is_none_or(|runs| place.run <= runs)).collect();
    let play = PlayArgs { server: with_tasks_of(&args.play.server, &plan)?, ..args.play.clone() };
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let mut connected = None;
    let mut counts = HeatmapCounts::default();
    // Make the missing heatmaps, one environment after the other.
    for places in selected.chunk_by(|a, b| a.environment == b.environment) {
        let (finished, unfinished): (Vec<_>, Vec<_>) = places.iter().partition(|place| place.selected.is_some());
        unfinished.iter().for_each(|place| note(format_args!("{place}: {}", NoHeatmap::NoResult)));
        if finished.is_empty() {
            continue;
        }
        let servers = match &mut connected {
            Some(servers) => servers,
            none => none.insert(playing_servers(&play, &stop)?),
        };
        let environment = servers.environment(places[0].environment)?;
        if let Some(reason) = missing_parameter(args, &environment) {
            note(format_args!("{reason}: left out"));
            counts.skipped_environments += 1;
            continue;
        }
        let parameters = match axes(args, &environment) {
            Ok(parameters) => parameters,
            Err(error) => {
                note(format_args!("{}: {error}", environment.name));
                counts.skipped_environments += 1;
                continue;
            }
        };
        let kind = HeatmapKind { parameters, base: args.base_version };
        counts.total += finished.len();
        for place in finished {
            counts.failed += usize::from(!make(args, &folder, place, &kind, servers, &stop)?);
        }
    }
    // Draw the means over runs of all heatmaps, including those that existed before.
    for file in save_heatmaps(&heatmap_pictures(&selections, Some(&folder))?, &report)? {
        writeln!(output(), "{}.png, .svg and .csv", report.join(file).display())?;
    }
    match counts {
        HeatmapCounts { failed, total, .. } if failed > 0 => {
            Err(CommandError::Failed(format!("{failed} of {total} heatmaps could not be made")))
        }
        HeatmapCounts { total: 0, skipped_environments, .. } if skipped_environments > 0 => Err(CommandError::Failed(
            "no environment of this experiment has both parameters: see `perturb envs`, and give --x and --y".into(),
        )),
        _ => Ok(()),
    }
}

/// Returns a sentence if the environment does not have the parameter of --x or --y.
fn missing_parameter(args: &HeatmapArgs, environment: &proto::Environment) -> Option<String> {
    let known = environment.parameters.iter().map(|parameter| parameter.name.as_str());
    let missing = args.x.iter().chain(&args.y).find(|name| names::find(name, known.clone()).is_none())?;
    let hint = names::did_you_mean(missing, known.clone());
    let known = known.collect::<Vec<_>>().join(", ");
    Some(format!("{} has no parameter `{missing}`{hint}, only {known}", environment.name))
}

/// Makes the heatmap of a selected policy unless it exists already. Returns whether it exists afterwards.
fn make(
    args: &HeatmapArgs,
    folder: &ExperimentFolder,
    place: &HeatmapPlace<'_>,
    kind: &HeatmapKind,
    servers: &Servers,
    stop: &StopFlag,
) -> Result<bool> {
    let Some(selected) = place.selected else { return Ok(false) };
    let options = options(args, kind, &selected.cell.config);
    if place.read(folder, kind)?.is_ok_and(|stored| stored.record.options == options) {
        note(format_args!("{place}: exists already"));
        return Ok(true);
    }
    let checkpoint = match checkpoint_of(folder, selected) {
        Ok(checkpoint) => checkpoint,
        Err(error) => {
            say(format_args!("{place}: {error}"));
            return Ok(false);
        }
    };
    let (heatmap, records) = test(servers, &checkpoint, &options, stop)
        .map_err(|error| CommandError::Heatmaps { place: place.to_string(), source: Box::new(error) })?;
    let id = checkpoint.id().map_err(|reason| CommandError::Failed(format!("{place}: {reason}")))?;
    let path = heatmap_path(folder, selected.cell, kind);
    // `store_heatmap` comes last, because its file marks the heatmap as complete.
    records.write(&path.with_added_extension("parquet"))?;
    store_heatmap(folder, selected.cell, id, options, &heatmap)?;
    writeln!(output(), "{}.csv and .parquet", path.display())?;
    Ok(true)
}

/// Loads the checkpoint of a cell, and checks that it belongs to the cell's result.
fn checkpoint_of(folder: &ExperimentFolder, Selected { cell, result }: Selected<'_>) -> Result<Checkpoint> {
    let checkpoint = Checkpoint::load(&folder.cell(&cell.id).training())?;
    let state = &checkpoint.state;
    let training = &result.training;
    if training.settings != state.config.table() || training.counters != state.counters {
        let message = format!("the checkpoint of {} does not belong to its result.json", cell.id);
        return Err(CommandError::Failed(message));
    }
    Ok(checkpoint)
}
