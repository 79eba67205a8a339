//! How far a training is.

use std::path::{Path, PathBuf};

use super::{LastProgress, RunSummary, last_progress};
use crate::AnyError;
use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::files::is_locked;
use crate::settings::TrainConfig;

/// A training, as its folder has it.
#[derive(Clone, Debug)]
pub struct TrainingStatus {
    /// Where it is.
    pub path: PathBuf,
    /// Its settings.
    pub config: TrainConfig,
    /// Episodes of the budget: of the last line of the log while it is in work, otherwise of the last checkpoint, from
    /// which it would go on.
    pub episodes: u64,
    /// The last line of its log; `None` before the first.
    pub progress: Option<LastProgress>,
    /// Episodes of the last checkpoint; `None` if there is none.
    pub saved: Option<u64>,
    /// What is wrong with the checkpoint.
    pub damaged: Option<String>,
    /// "in work", "finished", "broken off", "without a checkpoint".
    pub state: &'static str,
}

impl TrainingStatus {
    /// Of the training in `path`.
    ///
    /// # Errors
    /// If `config.toml` is not that of a training.
    pub fn read(path: &Path) -> Result<Self, AnyError> {
        let config = TrainConfig::load(Some(&path.join("config.toml")), &[], toml::Table::new())?;
        let progress = last_progress(&path.join("progress.csv"));
        let checkpoint = Checkpoint::load(path);
        let damaged = match &checkpoint {
            Err(CheckpointError::Missing { .. }) | Ok(_) => None,
            Err(error) => Some(error.to_string()),
        };
        let saved = checkpoint.ok().map(|checkpoint| checkpoint.state.counters.episodes);
        let (budget, stop) = (config.common.episodes, config.common.stop_at_success);
        let success = progress.as_ref().and_then(LastProgress::success_percent);
        let enough = stop > 0.0 && success >= Some(stop) || config.settings.is_random() && saved.is_some();
        let state = match saved.unwrap_or_default() {
            _ if is_locked(path) => "in work",
            saved if saved >= budget || enough => "finished",
            saved if saved > 0 => "broken off",
            _ => "without a checkpoint",
        };
        let logged = progress.as_ref().and_then(LastProgress::episodes).filter(|_| state == "in work");
        let episodes = logged.unwrap_or_default().max(saved.unwrap_or_default());
        Ok(Self { path: path.to_owned(), config, episodes, progress, saved, damaged, state })
    }

    /// What is trained, in a few words.
    pub fn what(&self) -> String {
        self.config.to_string()
    }

    /// In a few figures.
    pub fn summary(&self) -> RunSummary {
        RunSummary {
            path: self.path.clone(),
            what: self.what(),
            done: self.episodes,
            budget: self.config.common.episodes,
            unit: "episodes",
            success_percent: self.progress.as_ref().and_then(LastProgress::success_percent),
            state: self.state,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::{Lock, write_atomically};

    #[test]
    fn a_training_in_work_is_as_far_as_its_log_and_otherwise_as_its_checkpoint() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run");
        assert!(TrainingStatus::read(&path).is_err());
        let write = |name: &str, text: &str| write_atomically(&path.join(name), text.as_bytes()).unwrap();
        write("config.toml", "environment = 'CartPole'\nalgorithm = 'a2c'\nepisodes = 200");
        write("progress.csv", "rollout/episodes,rollout/success_rate\n120,0.25\n");
        let read = || TrainingStatus::read(&path).unwrap();
        let status = read();
        assert_eq!((status.state, status.episodes, status.saved), ("without a checkpoint", 0, None));
        let lock = Lock::try_take(&path).unwrap();
        let summary = read().summary();
        assert_eq!((summary.state, summary.done, summary.budget), ("in work", 120, 200));
        assert_eq!((summary.success_percent, summary.what.as_str()), (Some(25.0), "CartPole D a2c ff"));
        drop(lock);
        write("checkpoint/checkpoint.json", "{");
        let status = read();
        assert!(status.damaged.unwrap().contains("not a usable checkpoint") && status.state == "without a checkpoint");
    }
}
