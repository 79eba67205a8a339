//! `perturb video`.

use std::io::Write;

use super::args::VideoArgs;
use super::display::Display;
use super::error::{Result, system};
use super::{servers, sets};
use crate::video::{Footage, VideoFile, VideoOptions, film};
use perturb_learner::checkpoint::Checkpoint;
use perturb_study::interrupt::StopFlag;
use perturb_study::table::Table;

pub(super) fn run(args: &VideoArgs) -> Result<()> {
    let file = VideoFile::create(&args.out)?;
    let checkpoint = Checkpoint::load(&args.checkpoint)?;
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = servers(&args.server)?;
    let options = VideoOptions {
        set: sets::drawn(args.version, &args.parameters)?,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(checkpoint.state.config.common.seed),
        size: (args.width, args.height),
        fps: args.fps,
    };
    let mut display = Display::of_episodes(format!("filming on {}", options.set.name), args.episodes);
    let footage = film(&servers, &checkpoint, &options, file, &stop, &mut |episodes| display.episodes(episodes))?;
    drop(display);
    let mut out = std::io::stdout();
    let episodes: Vec<_> = footage.episodes.iter().enumerate().collect();
    let table = Table::of("", &episodes)
        .number("episode", |(index, _)| index + 1)
        .number("return", |(_, episode)| format!("{:.2}", episode.episode_return))
        .number("steps", |(_, episode)| episode.length)
        .text("success", |(_, episode)| if episode.success { "yes" } else { "no" })
        .text("parameters", |(_, episode)| {
            let parameters = episode.parameters.iter().map(|(name, value)| format!("{name}={value}"));
            parameters.collect::<Vec<_>>().join(" ")
        });
    writeln!(out, "{}", table.build().to_text())?;
    Ok(writeln!(out, "{}: {}", args.out.display(), figures(&footage))?)
}

/// How many frames there are, how fast they are shown, and how fast they were made.
fn figures(footage: &Footage) -> String {
    let Footage { frames, size: (width, height), speed, total, waiting, writing, .. } = footage;
    let milliseconds = |time: &std::time::Duration| 1e3 * time.as_secs_f64() / *frames as f64;
    format!(
        "{frames} frames of {width} × {height} pixels at {speed:.2} × real time; rendered and written at {:.0} frames/s: \
         each waited {:.1} ms for the server and took {:.1} ms to write",
        *frames as f64 / total.as_secs_f64(),
        milliseconds(waiting),
        milliseconds(writing),
    )
}
