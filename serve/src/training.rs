//! What is known of a training.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_study::files::{Stamp, is_locked, leads_out};
use perturb_study::runs::{LEADS_OUT, LastProgress, RunSummary, TrainingStatus};
use perturb_study::words::shortened;
use perturb_study::{CellResult, CellState, Folder, FolderError, generated_episodes};

use crate::curve::{Curve, Episodes};

/// How often it is looked whether somebody works on a run whose files stay the same.
pub(crate) const LOCK_INTERVAL: Duration = Duration::from_secs(5);
/// The files that say how far a training is.
const FILES: [&str; 3] = ["config.toml", "checkpoint/checkpoint.json", "progress.csv"];
/// All that is read of it.
const READ: [&str; 5] = ["config.toml", "checkpoint/checkpoint.json", "checkpoint.json", "progress.csv", "monitor.csv"];

/// A training that is looked at now and then.
#[derive(Debug)]
pub(crate) struct Training {
    /// What links may not lead out of.
    root: PathBuf,
    path: PathBuf,
    stamps: [Option<Stamp>; FILES.len()],
    looked: Option<Instant>,
    status: Result<TrainingStatus, String>,
    /// Read as soon as somebody wants to see the curve.
    episodes: Option<Episodes>,
}

impl Training {
    /// That in `path`, of which nothing is shown that is outside of `root`.
    pub(crate) fn of(root: &Path, path: &Path) -> Self {
        let (root, path, status) = (root.to_owned(), path.to_owned(), Err("it was not looked at".into()));
        Self { root, path, stamps: Default::default(), looked: None, status, episodes: None }
    }

    /// Reads what has changed of its state.
    pub(crate) fn look(&mut self) {
        if let Some(name) = READ.into_iter().find(|name| leads_out(&self.root, &self.path, name)) {
            *self = Self { status: Err(format!("{name} is {LEADS_OUT}")), ..Self::of(&self.root, &self.path) };
            return;
        }
        let stamps = FILES.map(|name| Stamp::of(&self.path.join(name)));
        let rested = self.looked.is_none_or(|looked| looked.elapsed() >= LOCK_INTERVAL);
        let in_work = self.status.as_ref().is_ok_and(|status| status.state == "in work");
        if stamps != self.stamps || self.looked.is_none() || (rested && is_locked(&self.path) != in_work) {
            self.status = TrainingStatus::read(&self.path).map_err(|error| shortened(error.to_string()));
            self.stamps = stamps;
        }
        if rested {
            self.looked = Some(Instant::now());
        }
    }

    /// The same, and what is new of its curve.
    pub(crate) fn follow(&mut self) {
        self.look();
        if self.looked.is_some() {
            self.episodes.get_or_insert_with(|| Episodes::of(&self.path.join("monitor.csv"))).look();
        }
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

    /// Those of some files that are there and may be sent.
    pub(crate) fn files(&self) -> impl Iterator<Item = &'static str> {
        let sent = |name: &&str| self.path.join(name).is_file() && !leads_out(&self.root, &self.path, name);
        ["config.toml", "monitor.csv", "progress.csv"].into_iter().filter(sent)
    }

    /// What the experiment recorded of it, if it is that of a cell; what is wrong with it, or with the record.
    pub(crate) fn result(&self) -> Option<Result<Box<CellResult>, String>> {
        let cell = self.path.parent().filter(|_| self.path.ends_with("training"))?;
        let experiment = cell.parent().filter(|cells| cells.ends_with("cells"))?.parent()?;
        if !experiment.starts_with(&self.root) {
            return None; // the cell alone is served
        }
        if let Some(name) = ["result.json", "failure.json"].into_iter().find(|name| leads_out(&self.root, cell, name)) {
            return Some(Err(format!("{name} of the cell is {LEADS_OUT}")));
        }
        match Folder::new(experiment).cell(cell.file_name()?.to_str()?).state() {
            Ok(CellState::Done(result)) => Some(Ok(result)),
            Ok(CellState::Failed(failure)) => Some(Err(format!("The cell failed: {}", shortened(failure.reason)))),
            Ok(CellState::Missing) => None,
            Err(FolderError::Damaged { path, reason }) => {
                Some(Err(FolderError::Damaged { path, reason: shortened(reason) }.to_string()))
            }
            Err(error) => Some(Err(error.to_string())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_read_behind_a_link_that_leads_out() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().canonicalize().unwrap().join("root");
        let run = root.join("run");
        std::fs::create_dir_all(&run).unwrap();
        let write = |name: &str, text: &str| std::fs::write(run.join(name), text).unwrap();
        write("config.toml", "environment = 'CartPole'\nalgorithm = 'a2c'\nepisodes = 200");
        write("monitor.csv", "r,l,t,success\n1,2,3,1\n");
        let mut training = Training::of(&root, &run);
        training.follow();
        assert_eq!((training.count(), training.files().collect::<Vec<_>>()), (1, vec!["config.toml", "monitor.csv"]));
        for name in ["progress.csv", "monitor.csv", "config.toml"] {
            std::fs::write(directory.path().join("secret"), "secret = {").unwrap();
            let _ = std::fs::rename(run.join(name), run.join("kept"));
            std::os::unix::fs::symlink(directory.path().join("secret"), run.join(name)).unwrap();
            training.follow();
            assert_eq!(training.status().unwrap_err(), format!("{name} is a link that leads out of the folder"));
            assert!(training.count() == 0 && training.troubles().is_empty());
            std::fs::remove_file(run.join(name)).unwrap();
            let _ = std::fs::rename(run.join("kept"), run.join(name));
            training.follow();
            assert!(training.status().is_ok() && training.count() == 1, "{name} is as before");
        }
    }
}
