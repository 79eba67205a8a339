//! The heatmaps of an experiment.

use std::io::Write;
use std::path::Path;

use perturb_experiment::{
    Folder, HeatmapPlace, NoHeatmap, Results, Selected, heatmap_path, heatmap_places, store_heatmap,
};
use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;
use perturb_learner::proto;
use perturb_protocol::names;
use perturb_records::HeatmapKind;
use perturb_report::{heatmap_pictures, save_heatmaps};

use super::{options, test, wanted_axes};
use crate::commands::args::HeatmapArgs;
use crate::commands::display::{note, say};
use crate::commands::error::{CommandError, Result, system};
use crate::commands::{plan_in, playing_servers};

/// What became of places.
#[derive(Default)]
struct Count {
    /// Of environments with both parameters.
    wanted: usize,
    /// Without a heatmap, though there is a result.
    failed: usize,
    /// Environments that lack a parameter.
    lacking: usize,
}

/// Makes what is missing, and draws everything that is there.
pub(super) fn run(args: &HeatmapArgs, directory: &Path) -> Result<()> {
    let folder = Folder::new(directory);
    let plan = plan_in(&folder)?;
    let results = Results::read(&plan, &folder)?;
    let selections = results.select();
    let places = heatmap_places(&selections);
    let wanted: Vec<&HeatmapPlace<'_>> =
        places.iter().filter(|place| args.runs.is_none_or(|runs| place.run <= runs)).collect();
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let mut servers_of_all = None;
    let mut count = Count::default();
    for places in wanted.chunk_by(|a, b| a.environment == b.environment) {
        let (done, waiting): (Vec<_>, Vec<_>) = places.iter().partition(|place| place.selected.is_some());
        waiting.iter().for_each(|place| note(format_args!("{place}: {}", NoHeatmap::NoResult)));
        if done.is_empty() {
            continue;
        }
        let servers = match &mut servers_of_all {
            Some(servers) => servers,
            none => none.insert(playing_servers(&args.play)?),
        };
        let environment = servers.environment(places[0].environment)?;
        if let Some(lack) = lack(args, &environment) {
            note(format_args!("{lack}: left out"));
            count.lacking += 1;
            continue;
        }
        let parameters = match wanted_axes(args, &environment) {
            Ok(parameters) => parameters,
            Err(why) => {
                note(format_args!("{}: {why}", environment.name));
                count.lacking += 1;
                continue;
            }
        };
        let kind = HeatmapKind { parameters, base: args.base };
        count.wanted += done.len();
        for place in done {
            count.failed += usize::from(!make(args, &folder, place, &kind, servers, &stop)?);
        }
    }
    let report = folder.path().join("report");
    for file in save_heatmaps(&heatmap_pictures(&selections, Some(&folder))?, &report)? {
        writeln!(std::io::stdout(), "{}.png, .svg and .csv", report.join(file).display())?;
    }
    match count {
        Count { failed, wanted, .. } if failed > 0 => {
            Err(CommandError::Failed(format!("{failed} of {wanted} heatmaps could not be made")))
        }
        Count { wanted: 0, lacking, .. } if lacking > 0 => Err(CommandError::Failed(
            "no environment of this experiment has two parameters to show: see `perturb envs`, and give --x and --y"
                .into(),
        )),
        _ => Ok(()),
    }
}

/// What an environment lacks of the parameters that are asked for.
fn lack(args: &HeatmapArgs, environment: &proto::Environment) -> Option<String> {
    let known = environment.parameters.iter().map(|parameter| parameter.name.as_str());
    let lacking = args.x.iter().chain(&args.y).find(|name| names::find(name, known.clone()).is_none())?;
    let hint = names::did_you_mean(lacking, known.clone());
    let known = known.collect::<Vec<_>>().join(", ");
    Some(format!("{} has no parameter `{lacking}`{hint}, only {known}", environment.name))
}

/// Makes a heatmap, unless it is there; whether it is there then.
fn make(
    args: &HeatmapArgs,
    folder: &Folder,
    place: &HeatmapPlace<'_>,
    kind: &HeatmapKind,
    servers: &Servers,
    stop: &StopFlag,
) -> Result<bool> {
    let Some(selected) = place.selected else { return Ok(false) };
    let options = options(args, kind, &selected.cell.config);
    if place.read(folder, kind)?.is_ok_and(|stored| stored.record.options == options) {
        note(format_args!("{place}: is there already"));
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
        .map_err(|error| CommandError::Place { place: place.to_string(), source: Box::new(error) })?;
    let id = checkpoint.id().map_err(|reason| CommandError::Failed(format!("{place}: {reason}")))?;
    let path = heatmap_path(folder, selected.cell, kind);
    // Before the heatmap, whose record is what tells that it is complete.
    records.write(&path.with_added_extension("parquet"))?;
    store_heatmap(folder, selected.cell, id, options, &heatmap)?;
    writeln!(std::io::stdout(), "{}.csv and .parquet", path.display())?;
    Ok(true)
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
