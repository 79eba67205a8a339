//! `perturb video`.

use std::io::Write;

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_text::Table;

use super::args::VideoArgs;
use super::display::{Display, note};
use super::error::{CommandError, Result, system};
use super::{servers, sets};
use crate::video::{Footage, Format, VideoFile, VideoOptions, film};

/// Of a whole episode so many pictures are drawn for a contact sheet, which takes few: a robot's takes some 60 ms.
const MOMENTS: u32 = 500;

pub(super) fn run(args: &VideoArgs) -> Result<()> {
    let is_sheet = Format::of(&args.out)? == Format::Png;
    if is_sheet && args.fps.is_some() {
        return Err(CommandError::Usage(
            "--fps is how fast a film is shown: leave it out, or write a .gif or .mp4".into(),
        ));
    }
    let file = VideoFile::create(&args.out)?;
    let checkpoint = Checkpoint::load(&args.checkpoint)?;
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = servers(&args.server)?;
    let width = args.width.unwrap_or(if is_sheet { 240 } else { 480 });
    let environment = servers.environment(&checkpoint.state.config.common.environment)?;
    let sets = args
        .version
        .iter()
        .map(|&version| -> Result<_> { Ok(sets::spelled_set(sets::drawn(version, &args.parameters)?, &environment)?) });
    let options = VideoOptions {
        sets: sets.collect::<Result<_>>()?,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(checkpoint.state.config.common.seed),
        size: (width, args.height.unwrap_or(width)),
        fps: args.fps,
        every: if is_sheet { (checkpoint.state.environment_spec.step_limit / MOMENTS).max(1) } else { 1 },
    };
    let names: Vec<&str> = options.sets.iter().map(|set| &*set.name).collect();
    let total = args.episodes.saturating_mul(names.len() as u64);
    let mut display = Display::of_episodes(format!("filming on {}", names.join(", ")), total);
    let footage = film(&servers, &checkpoint, &options, file, &stop, &mut |episodes| display.episodes(episodes))?;
    drop(display);
    if let Some(sentence) = footage.thinning() {
        note(sentence);
    }
    let mut out = std::io::stdout();
    let episodes: Vec<_> = footage.episodes.iter().enumerate().collect();
    let table = Table::of("", &episodes)
        .number("episode", |(index, _)| index + 1)
        .number("return", |(_, episode)| format!("{:.2}", episode.episode_return))
        .number("steps", |(_, episode)| episode.length)
        .text("success", |(_, episode)| if episode.success { "yes" } else { "no" })
        .text("on", |(_, episode)| episode.set.clone())
        .text("parameters", |(_, episode)| {
            let parameters = episode.parameters.iter().map(|(name, value)| format!("{name}={value}"));
            parameters.collect::<Vec<_>>().join(" ")
        });
    writeln!(out, "{}", table.build().to_text())?;
    let what = if is_sheet { sheet(&footage) } else { figures(&footage) };
    Ok(writeln!(out, "{}: {what}", args.out.display())?)
}

/// What a contact sheet has.
fn sheet(Footage { frames, size: (width, height), .. }: &Footage) -> String {
    format!("moments out of {frames} frames, on {width} × {height} pixels")
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
