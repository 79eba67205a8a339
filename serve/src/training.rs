//! What is known of a training.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_study::files::is_locked;
use perturb_study::runs::{LastProgress, RunSummary, TrainingStatus};
use perturb_study::{CellResult, CellState, Folder, generated_episodes};

use crate::curve::{Curve, Episodes};
use crate::stamp::Stamp;

/// How often it is looked whether somebody works on a run whose files stay the same. Looking takes a lock for a moment.
pub(crate) const LOCK_INTERVAL: Duration = Duration::from_secs(5);
/// The files that say how far a training is.
const FILES: [&str; 3] = ["config.toml", "checkpoint/checkpoint.json", "progress.csv"];

/// A training that is looked at now and then.
#[derive(Debug)]
pub(crate) struct Training {
    path: PathBuf,
    stamps: [Option<Stamp>; FILES.len()],
    looked: Option<Instant>,
    status: Result<TrainingStatus, String>,
    /// Read as soon as somebody wants to see the curve.
    episodes: Option<Episodes>,
}

impl Training {
    pub(crate) fn of(path: &Path) -> Self {
        let status = Err("it was not looked at".into());
        Self { path: path.to_owned(), stamps: Default::default(), looked: None, status, episodes: None }
    }

    /// Reads what has changed of its state.
    pub(crate) fn look(&mut self) {
        let stamps = FILES.map(|name| Stamp::of(&self.path.join(name)));
        let rested = self.looked.is_none_or(|looked| looked.elapsed() >= LOCK_INTERVAL);
        let in_work = self.status.as_ref().is_ok_and(|status| status.state == "in work");
        if stamps != self.stamps || self.looked.is_none() || (rested && is_locked(&self.path) != in_work) {
            self.status = TrainingStatus::read(&self.path).map_err(|error| error.to_string());
            self.stamps = stamps;
        }
        if rested {
            self.looked = Some(Instant::now());
        }
    }

    /// The same, and what is new of its curve.
    pub(crate) fn follow(&mut self) {
        self.look();
        self.episodes.get_or_insert_with(|| Episodes::of(&self.path.join("monitor.csv"))).look();
    }

    /// How far it is, or why that is not known.
    pub(crate) fn status(&self) -> Result<&TrainingStatus, &str> {
        self.status.as_ref().map_err(String::as_str)
    }

    pub(crate) fn summary(&self) -> RunSummary {
        self.status.as_ref().map_or_else(|_| RunSummary::not_understood(&self.path), TrainingStatus::summary)
    }

    /// When it last changed, s since 1970.
    pub(crate) fn changed(&self) -> i64 {
        self.stamps.iter().flatten().map(Stamp::seconds).max().unwrap_or_default()
    }

    /// How many episodes its log has.
    pub(crate) fn count(&self) -> usize {
        self.episodes.as_ref().map_or(0, Episodes::count)
    }

    pub(crate) fn curve(&self) -> Curve {
        self.episodes.as_ref().map(Episodes::curve).unwrap_or_default()
    }

    /// What is wrong with its files, beside the configuration.
    pub(crate) fn troubles(&self) -> Vec<String> {
        let log = self.episodes.as_ref().and_then(Episodes::wrong).map(|wrong| format!("monitor.csv: {wrong}"));
        let checkpoint = self.status.as_ref().ok().and_then(|status| status.damaged.clone());
        log.into_iter().chain(checkpoint).collect()
    }

    /// How long it may still take, s, if its last episodes say how it goes on.
    pub(crate) fn left(&self) -> Option<f64> {
        let status = self.status.as_ref().ok().filter(|status| status.state == "in work")?;
        let (count, (length, speed)) = (self.episodes.as_ref()?.count() as f64, self.episodes.as_ref()?.recent()?);
        let all = generated_episodes(&status.config, status.config.common.episodes);
        (count < all).then(|| (all - count) * length / speed).filter(|seconds| seconds.is_finite())
    }

    /// Seconds that went to acting, waiting for servers, updating, and to anything else.
    pub(crate) fn shares(&self) -> Option<[f64; 4]> {
        let progress = self.status.as_ref().ok()?.progress.as_ref()?;
        let [acting, waiting, updating, all] =
            ["time/acting", "time/waiting", "time/updating", "time/time_elapsed"].map(|name| progress.get(name));
        let (acting, waiting, updating) = (acting?, waiting?, updating?);
        let rest = (all? - acting - waiting - updating).max(0.0);
        Some([acting, waiting, updating, rest])
    }

    pub(crate) fn progress(&self) -> Option<&LastProgress> {
        self.status.as_ref().ok()?.progress.as_ref()
    }

    /// What the experiment recorded of it, if it is that of a cell.
    pub(crate) fn result(&self) -> Option<Result<Box<CellResult>, String>> {
        let cell = self.path.parent().filter(|_| self.path.ends_with("training"))?;
        let experiment = cell.parent().filter(|cells| cells.ends_with("cells"))?.parent()?;
        match Folder::new(experiment).cell(cell.file_name()?.to_str()?).state() {
            Ok(CellState::Done(result)) => Some(Ok(result)),
            Ok(CellState::Failed(failure)) => Some(Err(failure.reason)),
            Ok(CellState::Missing) => None,
            Err(error) => Some(Err(error.to_string())),
        }
    }
}
