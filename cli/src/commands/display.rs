//! How far something is, on standard error: a bar on a terminal, which fits its width, plain lines elsewhere.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use perturb_experiment::generated_episodes;
use perturb_experiment::scheduler::{Pace, Status};
use perturb_learner::logging::{EpisodeFigures, Progress};
use perturb_settings::TrainConfig;
use perturb_text::{duration, grouped};

/// How often a plain line is printed.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// Of so many groups of cells in work, and of so many kinds that are done, a terminal shows what is known.
const MOST_SHOWN: usize = 8;
/// The time that is left is not told before so much has passed: it would be a guess.
const LEAST_ELAPSED: Duration = Duration::from_secs(1);

/// Whether nothing is said but errors.
static QUIET: AtomicBool = AtomicBool::new(false);
/// The bar that is on the terminal.
static SHOWN: Mutex<Option<MultiProgress>> = Mutex::new(None);

/// Has [`note`] and displays say nothing from now on.
pub(super) fn be_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

pub(super) fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// A sentence on standard error, unless nobody wants to hear it.
pub(super) fn note(sentence: impl std::fmt::Display) {
    if !is_quiet() {
        say(sentence);
    }
}

/// A line on standard error, even for those who want to hear nothing. That nobody reads it is no reason to stop.
pub(super) fn say(line: impl std::fmt::Display) {
    let _ = writeln!(BesideBar, "{line}");
}

/// Standard error, where lines go above the bar that is shown there.
pub(super) struct BesideBar;

impl Write for BesideBar {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.write_all(bytes)?;
        Ok(bytes.len())
    }

    fn write_all(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        match &*shown() {
            // Its `suspend` would panic where the terminal is gone.
            Some(bar) => bar.println(String::from_utf8_lossy(bytes).trim_end_matches('\n')),
            None => std::io::stderr().write_all(bytes),
        }
    }

    /// A line that came in pieces would be several.
    fn write_fmt(&mut self, words: std::fmt::Arguments<'_>) -> std::io::Result<()> {
        self.write_all(words.to_string().as_bytes())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

fn shown() -> MutexGuard<'static, Option<MultiProgress>> {
    SHOWN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Columns of the terminal that results are printed on, if they are.
pub(super) fn terminal_width() -> Option<usize> {
    std::io::stdout().is_terminal().then(|| usize::from(console::Term::stdout().size().1))
}

/// The episodes of a training or a test, or the cells of a run.
pub(super) struct Display {
    bar: Option<Bar>,
    what: String,
    unit: &'static str,
    total: u64,
    /// Of a training: its pace, and how many episodes it generates.
    pace: Option<(Pace, f64)>,
    start: Instant,
    last_line: Option<Instant>,
}

/// A bar with lines below it, which are cut where the terminal ends.
struct Bar {
    all: MultiProgress,
    bar: ProgressBar,
    lines: Vec<ProgressBar>,
}

impl Display {
    /// Of a training that has had so many episodes and steps.
    pub(super) fn of_training(what: String, config: &TrainConfig, episodes: u64, timesteps: u64) -> Self {
        let budget = config.common.episodes;
        let mut pace = Pace::default();
        pace.hear(generated_episodes(config, episodes), timesteps);
        let mut display = Self::of_episodes(what, budget);
        display.pace = Some((pace, generated_episodes(config, budget)));
        display
    }

    /// Of `what`, which has `total` episodes.
    pub(super) fn of_episodes(what: impl Into<String>, total: u64) -> Self {
        Self::new(format!("{} ", what.into()), "episodes", total)
    }

    /// Of a run of so many cells.
    pub(super) fn of_cells(total: usize) -> Self {
        Self::new(String::new(), "cells", total as u64)
    }

    fn new(what: String, unit: &'static str, total: u64) -> Self {
        let bar = (std::io::stderr().is_terminal() && !is_quiet()).then(|| Bar::new(&what, total));
        // What is over soon needs no line.
        let last_line = (unit == "episodes").then(Instant::now);
        Self { bar, what, unit, total, pace: None, start: Instant::now(), last_line }
    }

    /// After an iteration of a training.
    pub(super) fn training(&mut self, progress: &Progress) {
        let mut figures = Vec::new();
        if let Some((pace, total)) = &mut self.pace {
            pace.hear(progress.generated_episodes as f64, progress.timesteps);
            let (left, least) = (pace.left(*total), if pace.is_least(*total) { "at least " } else { "" });
            figures.extend(self.left(left).map(|left| format!("{least}{left}")));
        }
        if let Some(EpisodeFigures { episode_return, success, .. }) = progress.recent {
            figures.push(format!("success {:.0} %, return {episode_return:.1}", 100.0 * success));
        }
        figures.push(format!("{} steps/s", grouped(progress.fps() as usize)));
        self.show(progress.episodes, &figures, Vec::new);
    }

    /// So many episodes.
    pub(super) fn episodes(&mut self, episodes: u64) {
        let rest = self.total.saturating_sub(episodes) as f64 / episodes as f64;
        let left = self.left((episodes > 0).then_some(rest));
        self.show(episodes, &Vec::from_iter(left), Vec::new);
    }

    /// How far a run is, and on a terminal what is done with its groups of cells, and what came of those that are done.
    pub(super) fn cells(&mut self, status: &Status) {
        let Status { done, failed, running, doing, remaining, rates, .. } = status;
        let mut figures = vec![doing.clone()];
        if *failed > 0 {
            figures.push(format!("{failed} failed"));
        }
        if let Some(left) = remaining {
            let most = if left.at_most { "at most " } else { "" };
            figures.push(format!("{most}{} left", duration(left.time.as_secs_f64())));
        }
        let lines = || {
            let mut lines = first(running.iter().map(|group| format!("  {group}")).collect());
            lines.extend(first(rates.iter().map(|rate| format!("  done: {rate}")).collect()));
            lines
        };
        self.show((done + failed) as u64, &figures, lines);
    }

    /// "3 min 10 s left", given what is left in terms of what is done.
    fn left(&self, rest: Option<f64>) -> Option<String> {
        let elapsed = self.start.elapsed();
        let rest = rest.filter(|rest| rest.is_finite() && elapsed >= LEAST_ELAPSED)?;
        Some(format!("{} left", duration(elapsed.as_secs_f64() * rest)))
    }

    fn show(&mut self, position: u64, figures: &[String], lines: impl FnOnce() -> Vec<String>) {
        let position = position.min(self.total);
        let unit = self.unit;
        let counted = format!("{}/{} {unit}", grouped(position as usize), grouped(self.total as usize));
        let words = [&[counted], figures].concat();
        if let Some(bar) = &mut self.bar {
            let width = usize::from(console::Term::stderr().size().1);
            bar.show(position, [vec![fitting(&words, width)], lines()].concat());
        } else if !is_quiet() && self.last_line.is_none_or(|time| time.elapsed() >= LINE_INTERVAL) {
            self.last_line = Some(Instant::now());
            say(format_args!("{}{}", self.what, words.join(", ")));
        }
    }
}

/// As many of these figures as fit a line, the first in any case: half a figure would be another one.
fn fitting(figures: &[String], width: usize) -> String {
    let fits = |n: &usize| console::measure_text_width(&figures[..*n].join(", ")) <= width;
    let n = (1..=figures.len()).rev().find(fits).unwrap_or(1);
    figures[..n].join(", ")
}

/// As many lines as are shown, and how many more there are.
fn first(mut lines: Vec<String>) -> Vec<String> {
    let more = lines.len().saturating_sub(MOST_SHOWN);
    lines.truncate(MOST_SHOWN);
    lines.extend((more > 0).then(|| format!("  and {more} more")));
    lines
}

impl Bar {
    fn new(what: &str, total: u64) -> Self {
        let all = MultiProgress::new();
        let bar = ProgressBar::new(total).with_style(style("{prefix}{wide_bar} {percent:>3} %"));
        // Setting the prefix would draw the bar by itself, and nobody would wipe that away.
        let bar = all.add(bar.with_prefix(what.to_owned()));
        *shown() = Some(all.clone());
        Self { all, bar, lines: Vec::new() }
    }

    fn show(&mut self, position: u64, lines: Vec<String>) {
        while self.lines.len() < lines.len() {
            self.lines.push(self.all.add(ProgressBar::no_length().with_style(style("{wide_msg}"))));
        }
        for gone in self.lines.drain(lines.len()..) {
            gone.finish_and_clear();
            self.all.remove(&gone);
        }
        self.bar.set_position(position);
        self.lines.iter().zip(lines).for_each(|(line, words)| line.set_message(words));
    }
}

/// A style that is written here, and can be understood.
fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

impl Drop for Display {
    fn drop(&mut self) {
        if let Some(Bar { all, bar, lines }) = &self.bar {
            lines.iter().for_each(ProgressBar::finish_and_clear);
            bar.finish_and_clear();
            let _ = all.clear(); // the terminal is gone
            *shown() = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_whole_figures_as_many_as_fit() {
        let figures = ["2 935/5 000 episodes", "1 min 1 s left", "27 529 steps/s"].map(String::from);
        let whole = figures.join(", ");
        assert_eq!(fitting(&figures, whole.len()), whole);
        assert_eq!(fitting(&figures, whole.len() - 1), "2 935/5 000 episodes, 1 min 1 s left");
        assert_eq!(fitting(&figures, 5), "2 935/5 000 episodes");
    }
}
