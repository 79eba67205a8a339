//! `perturb heatmap`.

use std::io::Write;

use anyhow::{Context, Result};

use super::args::HeatmapArgs;
use super::bar::Bar;
use super::report::write_file;
use super::{Ending, servers};
use crate::checkpoint::Checkpoint;
use crate::experiment::plot::{draw_heatmap, save};
use crate::experiment::{HeatmapOptions, heatmap, heatmap_csv};
use crate::interrupt::StopFlag;

pub(super) fn run(args: &HeatmapArgs) -> Result<Ending> {
    let checkpoint = Checkpoint::load(&args.checkpoint)?;
    let stop = StopFlag::on_signals().context("cannot wait for signals")?;
    let servers = servers(&args.server, args.grid * args.grid)?;
    let options = HeatmapOptions {
        parameters: [args.x.clone(), args.y.clone()],
        grid: args.grid,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(checkpoint.state.seed),
    };
    let total = (args.grid * args.grid) as u64 * args.episodes;
    let mut bar = Bar::new(format!("testing over {} and {}", args.x, args.y), total);
    let heatmap = heatmap(&servers, &checkpoint, &options, &stop, &mut |episodes| bar.testing(episodes))?;
    drop(bar);
    let name = format!("heatmap-{}-{}", args.x, args.y);
    let path = args.out.clone().unwrap_or_else(|| args.checkpoint.join(name));
    let with = |ending: &str| {
        let mut name = path.clone().into_os_string();
        name.push(ending);
        std::path::PathBuf::from(name)
    };
    write_file(&with(".csv"), &heatmap_csv(&heatmap)?)?;
    save(&draw_heatmap(&heatmap), &with(".svg"))?;
    let mut out = std::io::stdout();
    [".csv", ".svg", ".png"].iter().try_for_each(|ending| writeln!(out, "{}", with(ending).display()))?;
    Ok(Ending::Done)
}
