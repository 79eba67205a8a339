//! Progress: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use perturb_learner::logging::Progress;

/// How often a plain line is printed.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Shows how far something is, on standard error.
pub(super) struct Bar {
    bar: Option<ProgressBar>,
    what: String,
    total: u64,
    last_line: Instant,
}

impl Bar {
    /// Of `what`, which has `total` episodes.
    pub(super) fn new(what: impl Into<String>, total: u64) -> Self {
        let what = what.into();
        let bar = std::io::stderr().is_terminal().then(|| {
            let template = "{prefix} {wide_bar} {pos}/{len} episodes, {eta} left  {msg}";
            let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
            ProgressBar::new(total).with_style(style).with_prefix(what.clone())
        });
        Self { bar, what, total, last_line: Instant::now() }
    }

    /// After an iteration of a training.
    pub(super) fn training(&mut self, progress: &Progress) {
        let figures = match progress.recent {
            Some([episode_return, _, success]) => {
                let percent = 100.0 * success;
                format!("return {episode_return:.1}, success {percent:.0} %, {:.0} steps/s", progress.fps())
            }
            None => format!("{:.0} steps/s", progress.fps()),
        };
        self.show(progress.episodes, &figures);
    }

    /// After a step of a test.
    pub(super) fn testing(&mut self, episodes: u64) {
        self.show(episodes, "");
    }

    fn show(&mut self, episodes: u64, figures: &str) {
        if let Some(bar) = &self.bar {
            bar.set_position(episodes.min(self.total));
            if !figures.is_empty() {
                bar.set_message(figures.to_owned());
            }
        } else if self.last_line.elapsed() >= LINE_INTERVAL {
            self.last_line = Instant::now();
            let separator = if figures.is_empty() { "" } else { ": " };
            eprintln!("{}: {episodes}/{} episodes{separator}{figures}", self.what, self.total);
        }
    }

    /// Takes the bar away.
    pub(super) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.finish();
    }
}
