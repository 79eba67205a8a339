//! The status of a training: its progress and whether it is running, finished or interrupted.

use std::path::{Path, PathBuf};

use perturb_checkpoint::{CheckpointError, State};
use perturb_files::{AnyError, is_locked, read_toml};
use perturb_settings::{ConfigError, TrainConfig};
use perturb_text::shortened;

use super::{LastProgress, RunSummary, last_progress};

/// Number of recent episodes whose success rate may end a training. A training must have at least this many episodes
/// before its success rate can end it.
const RECENT: u64 = 100;

/// The status of a training, as read from its folder.
#[derive(Clone, Debug)]
pub struct TrainingStatus {
    /// The folder of the training.
    pub path: PathBuf,
    /// The settings of the training.
    pub config: TrainConfig,
    /// Number of finished episodes that count towards the budget. While the training runs, it is the larger of the
    /// numbers in the last line of `progress.csv` and in the last checkpoint. Otherwise it is the number in the last
    /// checkpoint, from which the training would resume.
    pub episodes: u64,
    /// The last line of `progress.csv`; `None` before the first line.
    pub progress: Option<LastProgress>,
    /// Number of episodes at the last checkpoint; `None` if there is none.
    pub saved: Option<u64>,
    /// The error of reading the checkpoint; `None` if it is intact or missing.
    pub damaged: Option<String>,
    /// The state: "in work", "finished", "broken off" or "without a checkpoint".
    pub state: &'static str,
    /// Whether the training has reached its budget or its target success rate. Its `state` may still be "in work",
    /// because a cell tests the policy after the training.
    pub over: bool,
}

impl TrainingStatus {
    /// Reads the status of the training in `path`.
    ///
    /// # Errors
    /// An error if `config.toml` cannot be read or is not the configuration of a training.
    pub fn read(path: &Path) -> Result<Self, AnyError> {
        let config = read_config(&path.join("config.toml"))?;
        let progress = last_progress(&path.join("progress.csv"));
        let checkpoint = State::load(path);
        let damaged = match &checkpoint {
            Err(CheckpointError::Missing { .. }) | Ok(_) => None,
            Err(error) => Some(shortened(error.to_string())),
        };
        let saved = checkpoint.ok().map(|state| state.counters.episodes);
        let (budget, stop) = (config.common.episodes, config.common.stop_at_success);
        let success = progress.as_ref().and_then(LastProgress::success_percent);
        let enough = stop > 0.0 && success >= Some(stop) || !config.settings.learns() && saved.is_some();
        let state = match saved.unwrap_or_default() {
            _ if is_locked(path) => "in work",
            saved if saved >= budget || enough => "finished",
            saved if saved > 0 => "broken off",
            _ => "without a checkpoint",
        };
        let logged = progress.as_ref().and_then(LastProgress::episodes).filter(|_| state == "in work");
        let episodes = logged.unwrap_or_default().max(saved.unwrap_or_default());
        let recent = progress.as_ref().and_then(LastProgress::episodes).unwrap_or_default().max(episodes) >= RECENT;
        let over = saved >= Some(budget) || stop > 0.0 && recent && success >= Some(stop) || state == "finished";
        Ok(Self { path: path.to_owned(), config, episodes, progress, saved, damaged, state, over })
    }

    /// Returns a description of the training, e.g. "CartPole D a2c ff".
    pub fn what(&self) -> String {
        self.config.to_string()
    }

    /// Returns the summary of the training.
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

/// Reads the configuration of a training from its `config.toml`.
fn read_config(path: &Path) -> Result<TrainConfig, AnyError> {
    let origin = path.display().to_string();
    let table = read_toml(path)?.parse().map_err(|error: toml::de::Error| ConfigError::Syntax {
        origin: origin.clone(),
        reason: error.to_string().trim().to_owned(),
    })?;
    Ok(TrainConfig::from_table(&origin, table)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use perturb_files::{Lock, write_atomically};

    #[test]
    fn progress_is_from_the_log_or_the_checkpoint() {
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
        assert!(!read().over);
        let summary = read().summary();
        assert_eq!((summary.state, summary.done, summary.budget), ("in work", 120, 200));
        assert_eq!((summary.success_percent, summary.what.as_str()), (Some(25.0), "CartPole D a2c ff"));
        let config = "environment = 'CartPole'\nalgorithm = 'a2c'\nepisodes = 200";
        write("config.toml", &format!("{config}\nstop_at_success = 25"));
        let status = read();
        assert!(status.over && status.state == "in work", "its policy may be in tests now");
        write("config.toml", config);
        drop(lock);
        write("checkpoint/checkpoint.json", "{");
        let status = read();
        assert!(status.damaged.unwrap().contains("not a usable checkpoint") && status.state == "without a checkpoint");
    }
}
