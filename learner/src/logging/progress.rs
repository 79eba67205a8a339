//! Writes `progress.csv` and the TensorBoard events, which have the same scalars.

use std::fs::File;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::EventWriter;
use super::disk::sync;
use crate::algorithm::UpdateStats;
use crate::client::EndedEpisode;

/// Return, length and success of an episode, or their means over several episodes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeFigures {
    /// The undiscounted return.
    pub episode_return: f64,
    /// The length in steps.
    pub length: f64,
    /// 1 for a success, otherwise 0; as a mean, the success rate (0 to 1).
    pub success: f64,
}

/// The time of a training by activity, in seconds or in percent of the whole time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TimeShares {
    /// Time spent on choosing actions.
    pub acting: f64,
    /// Time spent on waiting for servers.
    pub waiting: f64,
    /// Time spent on updating the policy.
    pub updating: f64,
}

/// The state of a training after an iteration: a line of `progress.csv`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Number of iterations so far: a rollout and an update each.
    pub iterations: u64,
    /// Number of steps so far, summed over all environments.
    pub timesteps: u64,
    /// Seconds of training so far.
    pub elapsed: f64,
    /// Seconds of training so far by activity.
    pub shares: TimeShares,
    /// Number of episodes so far that count towards the budget.
    pub episodes: u64,
    /// Number of finished episodes so far, including those that EPOpt generates but does not learn from.
    pub generated_episodes: u64,
    /// Number of steps at the last checkpoint on disk.
    pub saved_timesteps: u64,
    /// Means over the last 100 episodes; `None` before the first episode has ended.
    pub recent: Option<EpisodeFigures>,
    /// Statistics of the last update.
    pub update: UpdateStats,
}

impl From<&EndedEpisode> for EpisodeFigures {
    fn from(episode: &EndedEpisode) -> Self {
        Self {
            episode_return: episode.episode_return,
            length: f64::from(episode.length),
            success: f64::from(u8::from(episode.success)),
        }
    }
}

impl EpisodeFigures {
    /// Returns the means over `episodes`; `None` if there are none.
    pub fn mean<'a>(episodes: impl ExactSizeIterator<Item = &'a Self> + Clone) -> Option<Self> {
        let count = episodes.len() as f64;
        let mean = |figure: fn(&Self) -> f64| episodes.clone().map(figure).sum::<f64>() / count;
        (count > 0.0).then(|| Self {
            episode_return: mean(|episode| episode.episode_return),
            length: mean(|episode| episode.length),
            success: mean(|episode| episode.success),
        })
    }
}

impl Progress {
    /// Returns the steps of all environments per second of training.
    pub fn fps(&self) -> f64 {
        self.timesteps as f64 / self.elapsed.max(1e-9)
    }

    /// Returns the time by activity as percentages of the whole training time.
    pub fn percent(&self) -> TimeShares {
        let percent = |seconds: f64| 100.0 * seconds / self.elapsed.max(1e-9);
        let TimeShares { acting, waiting, updating } = self.shares;
        TimeShares { acting: percent(acting), waiting: percent(waiting), updating: percent(updating) }
    }

    /// Returns the columns of `progress.csv` with their values; `None` for an empty field. Names are those of
    /// stable-baselines3, except:
    ///
    /// - `time/acting`, `time/waiting` and `time/updating`: seconds so far spent on choosing actions, on waiting for
    ///   servers, and on updates;
    /// - `epopt/episodes_generated`: episodes that EPOpt has generated so far;
    /// - the other `epopt/…` columns: the last iteration's share ε, its number of selected episodes, the mean return of
    ///   all its episodes, and the mean return of its worst episodes (conditional value at risk).
    fn columns(&self) -> [(&'static str, Option<f64>); 29] {
        let Self { shares, recent, update, .. } = self;
        let selection = update.selection;
        [
            ("time/iterations", Some(self.iterations as f64)),
            ("time/total_timesteps", Some(self.timesteps as f64)),
            ("time/time_elapsed", Some(self.elapsed)),
            ("time/fps", Some(self.fps().trunc())),
            ("time/acting", Some(shares.acting)),
            ("time/waiting", Some(shares.waiting)),
            ("time/updating", Some(shares.updating)),
            ("rollout/episodes", Some(self.episodes as f64)),
            ("rollout/ep_rew_mean", recent.map(|recent| recent.episode_return)),
            ("rollout/ep_len_mean", recent.map(|recent| recent.length)),
            ("rollout/success_rate", recent.map(|recent| recent.success)),
            ("train/learning_rate", Some(update.learning_rate)),
            ("train/policy_gradient_loss", Some(update.policy_gradient_loss)),
            ("train/value_loss", Some(update.value_loss)),
            ("train/entropy_loss", Some(update.entropy_loss)),
            ("train/loss", Some(update.loss)),
            ("train/approx_kl", update.approx_kl),
            ("train/clip_fraction", update.clip_fraction),
            ("train/clip_range", update.clip_range),
            ("train/explained_variance", update.explained_variance),
            ("train/grad_norm", Some(update.grad_norm)),
            ("train/n_updates", Some(update.n_updates as f64)),
            ("train/std", update.std),
            ("train/kl_divergence", update.kl_divergence),
            ("epopt/episodes_generated", selection.map(|_| self.generated_episodes as f64)),
            ("epopt/epsilon", selection.map(|selection| selection.epsilon)),
            ("epopt/episodes_kept", selection.map(|selection| selection.kept as f64)),
            ("epopt/return_mean", selection.map(|selection| selection.mean_return)),
            ("epopt/return_cvar", selection.map(|selection| selection.cvar)),
        ]
    }
}

/// Writes the scalars of each iteration to `progress.csv` and to a TensorBoard events file.
#[derive(Debug)]
pub struct ProgressLog {
    csv: csv::Writer<File>,
    events: EventWriter,
}

impl ProgressLog {
    /// Creates `progress.csv` and an events file in `directory`. `t_start` is the start of the training in seconds
    /// since 1970.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn create(directory: &Path, t_start: f64) -> std::io::Result<Self> {
        let mut csv = csv::Writer::from_writer(File::create(directory.join("progress.csv"))?);
        csv.write_record(Progress::default().columns().map(|(name, _)| name))?;
        csv.flush()?;
        Ok(Self { csv, events: EventWriter::create(directory, t_start)? })
    }

    /// Returns a writer that continues at the ends of `csv` and `events`. `events_file` is the name of `events`.
    pub(super) fn resume(csv: File, events: File, events_file: String, t_start: f64) -> Self {
        Self { csv: csv::Writer::from_writer(csv), events: EventWriter::resume(events, events_file, t_start) }
    }

    /// Returns the name of the events file.
    pub(super) fn events_file(&self) -> &str {
        self.events.file_name()
    }

    /// Flushes both files to the disk. Returns the lengths of `progress.csv` and of the events file, in bytes.
    pub(super) fn sync(&mut self) -> std::io::Result<[u64; 2]> {
        self.csv.flush()?;
        Ok([sync(self.csv.get_ref(), "progress.csv")?, self.events.sync()?])
    }

    /// Writes a line to `progress.csv`, and an event. A missing value is an empty field in the line, and left out of
    /// the event.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn write(&mut self, progress: &Progress) -> std::io::Result<()> {
        let columns = progress.columns();
        self.csv.write_record(columns.map(|(_, value)| value.map_or_else(String::new, |value| value.to_string())))?;
        self.csv.flush()?;
        let scalars = columns.into_iter().filter_map(|(name, value)| Some((name, value?)));
        self.events.write(progress.timesteps, progress.elapsed, scalars)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::algorithm::EpisodeSelection;

    #[test]
    fn line_has_a_value_under_each_name() {
        let directory = tempfile::tempdir().unwrap();
        let mut log = ProgressLog::create(directory.path(), 0.0).unwrap();
        let update = UpdateStats {
            learning_rate: 0.5,
            policy_gradient_loss: -0.25,
            value_loss: 2.0,
            entropy_loss: -1.0,
            loss: 3.0,
            approx_kl: Some(0.125),
            clip_fraction: None,
            clip_range: Some(0.2),
            explained_variance: Some(0.75),
            grad_norm: 4.0,
            n_updates: 5,
            std: None,
            kl_divergence: None,
            selection: Some(EpisodeSelection { epsilon: 0.1, kept: 10, kept_steps: 50, mean_return: 7.0, cvar: 3.0 }),
        };
        let progress = Progress {
            iterations: 6,
            timesteps: 700,
            elapsed: 2.0,
            shares: TimeShares { acting: 0.25, waiting: 0.5, updating: 1.25 },
            episodes: 9,
            generated_episodes: 90,
            saved_timesteps: 0,
            recent: Some(EpisodeFigures { episode_return: 10.0, length: 11.0, success: 0.12 }),
            update,
        };
        log.write(&progress).unwrap();
        let text = std::fs::read_to_string(directory.path().join("progress.csv")).unwrap();
        let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split(',').collect()).collect();
        let cell = |name: &str| lines[1][lines[0].iter().position(|column| *column == name).unwrap()];
        for (name, value) in [
            ("time/iterations", "6"),
            ("time/total_timesteps", "700"),
            ("time/fps", "350"),
            ("time/waiting", "0.5"),
            ("rollout/ep_rew_mean", "10"),
            ("rollout/ep_len_mean", "11"),
            ("rollout/success_rate", "0.12"),
            ("epopt/episodes_generated", "90"),
            ("epopt/epsilon", "0.1"),
            ("epopt/episodes_kept", "10"),
            ("epopt/return_mean", "7"),
            ("epopt/return_cvar", "3"),
            ("train/approx_kl", "0.125"),
            ("train/clip_fraction", ""),
            ("train/explained_variance", "0.75"),
            ("train/n_updates", "5"),
            ("train/std", ""),
        ] {
            assert_eq!(cell(name), value, "{name}");
        }
    }
}
