//! The state of a training. It is read again when its files change.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_experiment::runs::{LEADS_OUT, LastProgress, RunSummary, TrainingStatus};
use perturb_experiment::{CellResult, CellState, ExperimentFolder, FolderError, generated_episodes};
use perturb_files::{Stamp, escapes_root, is_locked};
use perturb_text::shortened;

use crate::curve::{EpisodeLog, LearningCurve};

/// Time between two checks whether a process holds the lock of a run. A process can take or release the lock without
/// changing a file.
pub(crate) const LOCK_INTERVAL: Duration = Duration::from_secs(5);
/// Files from which a training's status is read.
const STATUS_FILES: [&str; 3] = ["config.toml", "checkpoint/checkpoint.json", "progress.csv"];
/// All files of a training that are read.
const READ_FILES: [&str; 5] =
    ["config.toml", "checkpoint/checkpoint.json", "checkpoint.json", "progress.csv", "monitor.csv"];

/// The state of a training at the last refresh.
#[derive(Debug)]
pub(crate) struct LiveTraining {
    /// The served folder. Symbolic links that lead out of it are not followed.
    root: PathBuf,
    path: PathBuf,
    stamps: [Option<Stamp>; STATUS_FILES.len()],
    /// Time of the last check of the lock; `None` before the first check, or if a symbolic link leads out of the served
    /// folder.
    checked: Option<Instant>,
    status: Result<TrainingStatus, String>,
    /// The log of episodes; `None` until the learning curve is requested.
    episodes: Option<EpisodeLog>,
}

impl LiveTraining {
    /// Makes an empty state of the training in the folder `path`. [`refresh`](Self::refresh) fills it. Files outside of
    /// `root` are not read.
    pub(crate) fn new(root: &Path, path: &Path) -> Self {
        let root = root.to_owned();
        let path = path.to_owned();
        let status = Err("it has not been read yet".into());
        Self { root, path, stamps: Default::default(), checked: None, status, episodes: None }
    }

    /// Reads the status again if its files have changed, or if a process has taken or released the training's lock.
    pub(crate) fn refresh(&mut self) {
        if let Some(name) = READ_FILES.into_iter().find(|name| escapes_root(&self.root, &self.path, name)) {
            *self = Self { status: Err(format!("{name} is {LEADS_OUT}")), ..Self::new(&self.root, &self.path) };
            return;
        }
        let stamps = STATUS_FILES.map(|name| Stamp::read(&self.path.join(name)));
        let lock_is_due = self.checked.is_none_or(|checked| checked.elapsed() >= LOCK_INTERVAL);
        let in_work = self.status.as_ref().is_ok_and(|status| status.state == "in work");
        if stamps != self.stamps || self.checked.is_none() || (lock_is_due && is_locked(&self.path) != in_work) {
            self.status = TrainingStatus::read(&self.path).map_err(|error| shortened(error.to_string()));
            self.stamps = stamps;
        }
        if lock_is_due {
            self.checked = Some(Instant::now());
        }
    }

    /// Refreshes the status and the learning curve.
    pub(crate) fn refresh_details(&mut self) {
        self.refresh();
        if self.checked.is_some() {
            self.episodes.get_or_insert_with(|| EpisodeLog::new(&self.path.join("monitor.csv"))).read_new();
        }
    }

    /// Returns the status, or the reason why it could not be read.
    pub(crate) fn status(&self) -> Result<&TrainingStatus, &str> {
        self.status.as_ref().map_err(String::as_str)
    }

    pub(crate) fn summary(&self) -> RunSummary {
        self.status.as_ref().map_or_else(|_| RunSummary::not_understood(&self.path), TrainingStatus::summary)
    }

    /// Returns the time of the last change, in seconds since 1970.
    pub(crate) fn changed(&self) -> i64 {
        self.stamps.iter().flatten().map(Stamp::seconds).max().unwrap_or_default()
    }

    /// Returns the number of episodes in the log.
    pub(crate) fn episode_count(&self) -> usize {
        self.episodes.as_ref().map_or(0, EpisodeLog::episode_count)
    }

    pub(crate) fn curve(&self) -> LearningCurve {
        self.episodes.as_ref().map(EpisodeLog::curve).unwrap_or_default()
    }

    /// Returns the error messages about the log of episodes and the checkpoint.
    pub(crate) fn faults(&self) -> Vec<String> {
        let log = self.episodes.as_ref().and_then(EpisodeLog::fault).map(|fault| format!("monitor.csv: {fault}"));
        let checkpoint = self.status.as_ref().ok().and_then(|status| status.damaged.clone());
        log.into_iter().chain(checkpoint).collect()
    }

    /// Returns the remaining time in seconds, at the speed of the last episodes. Returns `None` if the training is not
    /// running or the speed is not known.
    pub(crate) fn remaining_seconds(&self) -> Option<f64> {
        let status = self.status.as_ref().ok().filter(|status| status.state == "in work")?;
        let (count, (length, speed)) =
            (self.episodes.as_ref()?.episode_count() as f64, self.episodes.as_ref()?.recent()?);
        let all = generated_episodes(&status.config, status.config.common.episodes);
        (count < all).then(|| (all - count) * length / speed).filter(|seconds| seconds.is_finite())
    }

    /// Returns the time in seconds that was spent choosing actions, waiting for servers, updating the policy, and on
    /// everything else.
    pub(crate) fn time_shares(&self) -> Option<[f64; 4]> {
        let progress = self.status.as_ref().ok()?.progress.as_ref()?;
        let [acting, waiting, updating, all] =
            ["time/acting", "time/waiting", "time/updating", "time/time_elapsed"].map(|name| progress.get(name));
        let acting = acting?;
        let waiting = waiting?;
        let updating = updating?;
        let other = (all? - acting - waiting - updating).max(0.0);
        Some([acting, waiting, updating, other])
    }

    pub(crate) fn progress(&self) -> Option<&LastProgress> {
        self.status.as_ref().ok()?.progress.as_ref()
    }

    /// Returns the names of the training's text files that exist and may be sent.
    pub(crate) fn files(&self) -> impl Iterator<Item = &'static str> {
        let may_be_sent = |name: &&str| self.path.join(name).is_file() && !escapes_root(&self.root, &self.path, name);
        ["config.toml", "monitor.csv", "progress.csv"].into_iter().filter(may_be_sent)
    }

    /// Returns the result of the experiment's cell to which the training belongs, or the reason why the cell failed or
    /// its files are damaged. Returns `None` if there is no result yet, or if the training does not belong to a cell.
    pub(crate) fn result(&self) -> Option<Result<Box<CellResult>, String>> {
        let cell = self.path.parent().filter(|_| self.path.ends_with("training"))?;
        let experiment = cell.parent().filter(|cells| cells.ends_with("cells"))?.parent()?;
        if !experiment.starts_with(&self.root) {
            // Files of an experiment outside of the served folder are not read.
            return None;
        }
        if let Some(name) =
            ["result.json", "failure.json"].into_iter().find(|name| escapes_root(&self.root, cell, name))
        {
            return Some(Err(format!("{name} of the cell is {LEADS_OUT}")));
        }
        match ExperimentFolder::new(experiment).cell(cell.file_name()?.to_str()?).state() {
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
    fn links_out_of_the_folder_are_not_followed() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().canonicalize().unwrap().join("root");
        let run = root.join("run");
        std::fs::create_dir_all(&run).unwrap();
        let write = |name: &str, text: &str| std::fs::write(run.join(name), text).unwrap();
        write("config.toml", "environment = 'CartPole'\nalgorithm = 'a2c'\nepisodes = 200");
        write("monitor.csv", "r,l,t,success\n1,2,3,1\n");
        let mut training = LiveTraining::new(&root, &run);
        training.refresh_details();
        assert_eq!(
            (training.episode_count(), training.files().collect::<Vec<_>>()),
            (1, vec!["config.toml", "monitor.csv"])
        );
        for name in ["progress.csv", "monitor.csv", "config.toml"] {
            std::fs::write(directory.path().join("secret"), "secret = {").unwrap();
            let _ = std::fs::rename(run.join(name), run.join("kept"));
            std::os::unix::fs::symlink(directory.path().join("secret"), run.join(name)).unwrap();
            training.refresh_details();
            assert_eq!(training.status().unwrap_err(), format!("{name} is a link that leads out of the folder"));
            assert!(training.episode_count() == 0 && training.faults().is_empty());
            std::fs::remove_file(run.join(name)).unwrap();
            let _ = std::fs::rename(run.join("kept"), run.join(name));
            training.refresh_details();
            assert!(training.status().is_ok() && training.episode_count() == 1, "{name} is read again");
        }
    }
}
