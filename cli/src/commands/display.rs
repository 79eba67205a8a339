//! Messages and progress on standard error, and text on standard output. A terminal shows progress as a bar that fits
//! its width; other outputs get plain lines.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use perturb_experiment::scheduler::RunStatus;
use perturb_experiment::{TrainingProgress, generated_episodes};
use perturb_learner::logging::{EpisodeFigures, Progress};
use perturb_protocol::escape_lines;
use perturb_settings::TrainConfig;
use perturb_text::{duration, grouped};

/// Minimum time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// Maximum number of lines with running groups of cells, and maximum number of lines with success rates of finished
/// cells.
const MAX_SHOWN: usize = 8;
/// Time before the first estimate of the remaining time. Earlier estimates would be unreliable.
const MIN_ELAPSED: Duration = Duration::from_secs(1);

/// Whether --quiet is given, so that only warnings and errors are printed.
static QUIET: AtomicBool = AtomicBool::new(false);
/// The progress bars on the terminal and their number; `None` without a bar.
static CURRENT_BARS: Mutex<Option<(MultiProgress, usize)>> = Mutex::new(None);

/// Suppresses [`note`] and progress from now on.
pub(super) fn be_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

pub(super) fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// Prints a sentence on standard error, unless --quiet is given.
pub(super) fn note(sentence: impl std::fmt::Display) {
    if !is_quiet() {
        say(sentence);
    }
}

/// Prints a line on standard error, also with --quiet. Escapes control characters, because the line may contain texts
/// of servers and names of files. Ignores errors, so that a closed standard error does not end the command.
pub(super) fn say(line: impl std::fmt::Display) {
    let _ = writeln!(AboveBar, "{}", escape_lines(&line.to_string()));
}

/// Returns a writer to standard output that escapes control characters, because the text may contain texts of servers
/// and names of files.
pub(super) fn output() -> TextOutput {
    TextOutput(std::io::stdout())
}

/// A writer to standard output that escapes control characters.
pub(super) struct TextOutput(std::io::Stdout);

impl Write for TextOutput {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.write_all(escape_lines(&String::from_utf8_lossy(bytes)).as_bytes())?;
        Ok(bytes.len())
    }

    /// Writes the whole text at once, because a part of the text may end in the middle of a UTF-8 character.
    fn write_fmt(&mut self, words: std::fmt::Arguments<'_>) -> std::io::Result<()> {
        self.write_all(words.to_string().as_bytes())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

/// A writer to standard error that prints its lines above the progress bar.
pub(super) struct AboveBar;

impl Write for AboveBar {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.write_all(bytes)?;
        Ok(bytes.len())
    }

    fn write_all(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        match &*current_bars() {
            // `suspend` would panic if the terminal is gone.
            Some((bars, _)) => bars.println(String::from_utf8_lossy(bytes).trim_end_matches('\n')),
            None => std::io::stderr().write_all(bytes),
        }
    }

    /// Writes the whole text at once, because each write becomes a separate line above the bar.
    fn write_fmt(&mut self, words: std::fmt::Arguments<'_>) -> std::io::Result<()> {
        self.write_all(words.to_string().as_bytes())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

fn current_bars() -> MutexGuard<'static, Option<(MultiProgress, usize)>> {
    CURRENT_BARS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the width of the terminal on standard output, in columns. Returns `None` if standard output is not a
/// terminal.
pub(super) fn terminal_width() -> Option<usize> {
    std::io::stdout().is_terminal().then(|| usize::from(console::Term::stdout().size().1))
}

/// A display of the progress of a training or a test in episodes, or of an experiment in cells.
pub(super) struct Display {
    bar: Option<Bar>,
    what: String,
    unit: &'static str,
    total: u64,
    /// For a training: its progress, and the total number of episodes that it will generate.
    training_progress: Option<(TrainingProgress, f64)>,
    start: Instant,
    last_line: Option<Instant>,
}

/// A progress bar with lines of text below it. Lines are cut at the terminal's width.
struct Bar {
    all: MultiProgress,
    bar: ProgressBar,
    lines: Vec<ProgressBar>,
}

impl Display {
    /// Makes the display of a training that has already finished this number of episodes and steps.
    pub(super) fn for_training(what: String, config: &TrainConfig, episodes: u64, timesteps: u64) -> Self {
        let budget = config.common.episodes;
        let mut training_progress = TrainingProgress::default();
        training_progress.update(generated_episodes(config, episodes), timesteps);
        let mut display = Self::for_episodes(what, budget);
        display.training_progress = Some((training_progress, generated_episodes(config, budget)));
        display
    }

    /// Makes the display of a training or test with `total` episodes.
    pub(super) fn for_episodes(what: impl Into<String>, total: u64) -> Self {
        Self::new(format!("{} ", what.into()), "episodes", total)
    }

    /// Makes the display of an experiment with `total` cells.
    pub(super) fn for_cells(total: usize) -> Self {
        Self::new(String::new(), "cells", total as u64)
    }

    fn new(what: String, unit: &'static str, total: u64) -> Self {
        let bar = (std::io::stderr().is_terminal() && !is_quiet()).then(|| Bar::new(&what, total));
        // A training or test prints its first line after one interval, so a short one prints no line.
        let last_line = (unit == "episodes").then(Instant::now);
        Self { bar, what, unit, total, training_progress: None, start: Instant::now(), last_line }
    }

    /// Shows the progress after an iteration of a training.
    pub(super) fn training(&mut self, progress: &Progress) {
        let mut figures = Vec::new();
        if let Some((training_progress, total)) = &mut self.training_progress {
            training_progress.update(progress.generated_episodes as f64, progress.timesteps);
            let ratio = training_progress.remaining_ratio(*total);
            let bound = if training_progress.is_lower_bound(*total) { "at least " } else { "" };
            figures.extend(self.remaining_time(ratio).map(|time| format!("{bound}{time}")));
        }
        if let Some(EpisodeFigures { episode_return, success, .. }) = progress.recent {
            figures.push(format!("success {:.0} %, return {episode_return:.1}", 100.0 * success));
        }
        figures.push(format!("{} steps/s", grouped(progress.fps() as usize)));
        self.show(progress.episodes, &figures, Vec::new);
    }

    /// Shows the number of finished episodes.
    pub(super) fn episodes(&mut self, episodes: u64) {
        let ratio = self.total.saturating_sub(episodes) as f64 / episodes as f64;
        let time = self.remaining_time((episodes > 0).then_some(ratio));
        self.show(episodes, &Vec::from_iter(time), Vec::new);
    }

    /// Shows the progress of an experiment. A terminal also shows the running groups of cells, and the success rates of
    /// finished cells.
    pub(super) fn cells(&mut self, status: &RunStatus) {
        let RunStatus { done, failed, running, doing, remaining, rates, .. } = status;
        let mut figures = vec![doing.clone()];
        if *failed > 0 {
            figures.push(format!("{failed} failed"));
        }
        if let Some(left) = remaining {
            let bound = if left.at_most { "at most " } else { "" };
            figures.push(format!("{bound}{} left", duration(left.time.as_secs_f64())));
        }
        let lines = || {
            let mut lines = first_lines(running.iter().map(|group| format!("  {group}")).collect());
            lines.extend(first_lines(rates.iter().map(|rate| format!("  done: {rate}")).collect()));
            lines
        };
        self.show((done + failed) as u64, &figures, lines);
    }

    /// Returns a text such as "3 min 10 s left". `ratio` is the remaining work divided by the finished work.
    fn remaining_time(&self, ratio: Option<f64>) -> Option<String> {
        let elapsed = self.start.elapsed();
        let ratio = ratio.filter(|ratio| ratio.is_finite() && elapsed >= MIN_ELAPSED)?;
        Some(format!("{} left", duration(elapsed.as_secs_f64() * ratio)))
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

/// Joins the first `figures` that fit into `width` columns, at least one. Figures that do not fit are left out, because
/// a number that is cut off could be misread.
fn fitting(figures: &[String], width: usize) -> String {
    let fits = |n: &usize| console::measure_text_width(&figures[..*n].join(", ")) <= width;
    let n = (1..=figures.len()).rev().find(fits).unwrap_or(1);
    figures[..n].join(", ")
}

/// Returns the first [`MAX_SHOWN`] lines. If there are more, adds a line with their number.
fn first_lines(mut lines: Vec<String>) -> Vec<String> {
    let more = lines.len().saturating_sub(MAX_SHOWN);
    lines.truncate(MAX_SHOWN);
    lines.extend((more > 0).then(|| format!("  and {more} more")));
    lines
}

impl Bar {
    fn new(what: &str, total: u64) -> Self {
        let mut bars = current_bars();
        let (all, number) = bars.get_or_insert_with(|| (MultiProgress::new(), 0));
        *number += 1;
        let bar = ProgressBar::new(total).with_style(style("{prefix}{wide_bar} {percent:>3} %"));
        // The prefix is set before the bar is added. Setting it later would leave a second copy of the bar on the
        // screen.
        let bar = all.add(bar.with_prefix(what.to_owned()));
        Self { all: all.clone(), bar, lines: Vec::new() }
    }

    fn show(&mut self, position: u64, lines: Vec<String>) {
        while self.lines.len() < lines.len() {
            let line = ProgressBar::no_length().with_style(style("{wide_msg}"));
            self.lines.push(self.all.insert_after(self.lines.last().unwrap_or(&self.bar), line));
        }
        for unused in self.lines.drain(lines.len()..) {
            unused.finish_and_clear();
            self.all.remove(&unused);
        }
        self.bar.set_position(position);
        self.lines.iter().zip(lines).for_each(|(line, words)| line.set_message(words));
    }
}

/// Returns the style of a template. All templates are in this file and are valid.
fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

impl Drop for Display {
    fn drop(&mut self) {
        if let Some(Bar { all, bar, lines }) = &self.bar {
            lines.iter().chain([bar]).for_each(|line| {
                line.finish_and_clear();
                all.remove(line);
            });
            let mut bars = current_bars();
            if let Some((_, number)) = &mut *bars {
                *number -= 1;
                if *number == 0 {
                    // Clearing fails if the terminal is gone.
                    let _ = all.clear();
                    *bars = None;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_as_many_whole_figures_as_fit() {
        let figures = ["2 935/5 000 episodes", "1 min 1 s left", "27 529 steps/s"].map(String::from);
        let whole = figures.join(", ");
        assert_eq!(fitting(&figures, whole.len()), whole);
        assert_eq!(fitting(&figures, whole.len() - 1), "2 935/5 000 episodes, 1 min 1 s left");
        assert_eq!(fitting(&figures, 5), "2 935/5 000 episodes");
    }
}
