//! How far something is, on standard error: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::plan::duration;
use perturb_learner::logging::{EpisodeFigures, Progress};
use perturb_study::scheduler::Status;

/// How often a plain line is printed.
const LINE_INTERVAL: Duration = Duration::from_secs(10);
/// Of so many groups of cells in work a terminal shows what is being done.
const MOST_GROUPS: usize = 8;

/// The episodes of a training or a test, or the cells of a run.
pub(super) struct Display {
    bar: Option<ProgressBar>,
    what: String,
    unit: &'static str,
    total: u64,
    last_line: Option<Instant>,
}

impl Display {
    /// Of `what`, which has `total` episodes.
    pub(super) fn of_episodes(what: impl Into<String>, total: u64) -> Self {
        let template = "{prefix}{wide_bar} {pos}/{len} episodes, {eta} left  {msg}";
        Self::new(format!("{}: ", what.into()), "episodes", total, template)
    }

    /// Of a run of so many cells.
    pub(super) fn of_cells(total: usize) -> Self {
        Self::new(String::new(), "cells", total as u64, "{wide_bar} {pos}/{len} cells  {msg}\n{prefix}")
    }

    fn new(what: String, unit: &'static str, total: u64, template: &str) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::new(total).with_style(style).with_prefix(what.clone())
        });
        // What is over soon needs no line.
        let last_line = (unit == "episodes").then(Instant::now);
        Self { bar, what, unit, total, last_line }
    }

    /// After an iteration of a training.
    pub(super) fn training(&mut self, progress: &Progress) {
        let figures = match progress.recent {
            Some(EpisodeFigures { episode_return, success, .. }) => {
                let percent = 100.0 * success;
                format!("return {episode_return:.1}, success {percent:.0} %, {:.0} steps/s", progress.fps())
            }
            None => format!("{:.0} steps/s", progress.fps()),
        };
        self.show(progress.episodes, &figures);
    }

    /// So many episodes.
    pub(super) fn episodes(&mut self, episodes: u64) {
        self.show(episodes, "");
    }

    /// How far a run is, and on a terminal what is done with its groups of cells.
    pub(super) fn cells(&mut self, status: &Status) {
        let Status { done, failed, running, doing, remaining, .. } = status;
        let left = remaining.map_or_else(String::new, |left| format!(", {} left", duration(left.as_secs_f64())));
        let lost = if *failed > 0 { format!(", {failed} failed") } else { String::new() };
        if let Some(bar) = &self.bar {
            let mut in_work: Vec<String> = running.iter().take(MOST_GROUPS).map(|group| format!("  {group}")).collect();
            if running.len() > MOST_GROUPS {
                in_work.push(format!("  and {} more", running.len() - MOST_GROUPS));
            }
            bar.set_prefix(in_work.join("\n"));
        }
        self.show((done + failed) as u64, &format!("{doing}{lost}{left}"));
    }

    fn show(&mut self, position: u64, figures: &str) {
        if let Some(bar) = &self.bar {
            bar.set_position(position.min(self.total));
            if !figures.is_empty() {
                bar.set_message(figures.to_owned());
            }
        } else if self.last_line.is_none_or(|time| time.elapsed() >= LINE_INTERVAL) {
            self.last_line = Some(Instant::now());
            let separator = if figures.is_empty() { "" } else { ": " };
            eprintln!("{}{position}/{} {}{separator}{figures}", self.what, self.total, self.unit);
        }
    }

    /// A sentence beside it.
    pub(super) fn say(&self, sentence: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{sentence}")),
            None => eprintln!("{sentence}"),
        }
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
