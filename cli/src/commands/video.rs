//! `perturb video`: films a policy.

use std::io::Write;

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_text::Table;

use super::args::VideoArgs;
use super::display::{Display, note, output};
use super::error::{CommandError, Result, system};
use super::{servers, sets};
use crate::video::{Footage, Format, VideoFile, VideoOptions, film};

/// Approximate maximum number of frames that are drawn of each episode for a contact sheet. Rounding may almost double
/// the number. The maximum limits the time of drawing, about 60 ms for each frame of a robot.
const MAX_SHEET_FRAMES: u32 = 500;

pub(super) fn run(args: &VideoArgs) -> Result<()> {
    let is_sheet = Format::from_path(&args.out)? == Format::Png;
    if is_sheet && args.fps.is_some() {
        return Err(CommandError::Usage(
            "--fps is the speed of a film: leave it out, or write a .gif or .mp4 file".into(),
        ));
    }
    let file = VideoFile::create(&args.out)?;
    let checkpoint = Checkpoint::load(&args.checkpoint)?;
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = servers(&args.server, &stop)?;
    let width = args.width.unwrap_or(if is_sheet { 240 } else { 480 });
    let environment = servers.environment(&checkpoint.state.config.common.environment)?;
    let sets = args.version.iter().map(|&version| -> Result<_> {
        Ok(sets::normalize_set(sets::drawn_set(version, &args.parameters)?, &environment)?)
    });
    let options = VideoOptions {
        sets: sets.collect::<Result<_>>()?,
        episodes: args.episodes,
        seed: args.seed.unwrap_or(checkpoint.state.config.common.seed),
        size: (width, args.height.unwrap_or(width)),
        fps: args.fps,
        every: if is_sheet { (checkpoint.state.environment_spec.step_limit / MAX_SHEET_FRAMES).max(1) } else { 1 },
    };
    let names: Vec<&str> = options.sets.iter().map(|set| &*set.name).collect();
    let total = args.episodes.saturating_mul(names.len() as u64);
    let mut display = Display::for_episodes(format!("filming on {}", names.join(", ")), total);
    let footage = film(&servers, &checkpoint, &options, file, &stop, &mut |episodes| display.episodes(episodes))?;
    drop(display);
    if let Some(sentence) = footage.thinning() {
        note(sentence);
    }
    // Print a table with the filmed episodes.
    let mut out = output();
    let episodes: Vec<_> = footage.episodes.iter().enumerate().collect();
    let table = Table::builder("", &episodes)
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
    let summary = if is_sheet { sheet_summary(&footage) } else { film_summary(&footage) };
    Ok(writeln!(out, "{}: {summary}", args.out.display())?)
}

/// Returns a text with the number of frames and the size of a contact sheet.
fn sheet_summary(Footage { frames, size: (width, height), .. }: &Footage) -> String {
    format!("moments out of {frames} frames, on {width} × {height} pixels")
}

/// Returns a text with the frames, the size and the speed of a film, and how fast it was made.
fn film_summary(footage: &Footage) -> String {
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
