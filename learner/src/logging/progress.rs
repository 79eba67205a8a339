//! `progress.csv` and the TensorBoard events: the same scalars in two forms.

use std::fs::File;
use std::path::Path;

use super::EventWriter;
use super::logs::sync;
use crate::algorithm::UpdateStats;

/// The columns, by stable-baselines3's names; `time/acting`, `time/waiting` and `time/updating` are ours: seconds since
/// the start spent on choosing actions, on waiting for servers and on updates; and `epopt/…`: EPOpt's generated episodes
/// so far, and of the last iteration the share ε that was aimed at, the episodes kept, the mean return of all and that of
/// the worst (conditional value at risk).
const COLUMNS: [&str; 29] = [
    "time/iterations",
    "time/total_timesteps",
    "time/time_elapsed",
    "time/fps",
    "time/acting",
    "time/waiting",
    "time/updating",
    "rollout/episodes",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "rollout/success_rate",
    "train/learning_rate",
    "train/policy_gradient_loss",
    "train/value_loss",
    "train/entropy_loss",
    "train/loss",
    "train/approx_kl",
    "train/clip_fraction",
    "train/clip_range",
    "train/explained_variance",
    "train/grad_norm",
    "train/n_updates",
    "train/std",
    "train/kl_divergence",
    "epopt/episodes_generated",
    "epopt/epsilon",
    "epopt/episodes_kept",
    "epopt/return_mean",
    "epopt/return_cvar",
];

/// A line of `progress.csv`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Rollouts and updates so far.
    pub iterations: u64,
    /// Steps of all environments so far.
    pub timesteps: u64,
    /// Seconds since the start.
    pub elapsed: f64,
    /// Of these: choosing actions, waiting for servers, updating.
    pub shares: [f64; 3],
    /// Episodes that the budget counts.
    pub episodes: u64,
    /// Episodes that have ended; EPOpt generates more than it learns from.
    pub generated_episodes: u64,
    /// Steps that the last checkpoint on disk counts.
    pub saved_timesteps: u64,
    /// Mean return, mean length and share of successes of the last 100 episodes; `None` before the first has ended.
    pub recent: Option<[f64; 3]>,
    /// The last update.
    pub update: UpdateStats,
}

impl Progress {
    /// Steps of all environments in a second.
    pub fn fps(&self) -> f64 {
        self.timesteps as f64 / self.elapsed.max(1e-9)
    }

    /// The values of [`COLUMNS`]; `None` where there is nothing to say.
    fn values(&self) -> [Option<f64>; COLUMNS.len()] {
        let recent = |i: usize| self.recent.map(|recent| recent[i]);
        let update = &self.update;
        let selection = update.selection;
        [
            Some(self.iterations as f64),
            Some(self.timesteps as f64),
            Some(self.elapsed),
            Some(self.fps().trunc()),
            Some(self.shares[0]),
            Some(self.shares[1]),
            Some(self.shares[2]),
            Some(self.episodes as f64),
            recent(0),
            recent(1),
            recent(2),
            Some(update.learning_rate),
            Some(update.policy_gradient_loss),
            Some(update.value_loss),
            Some(update.entropy_loss),
            Some(update.loss),
            update.approx_kl,
            update.clip_fraction,
            update.clip_range,
            update.explained_variance,
            Some(update.grad_norm),
            Some(update.n_updates as f64),
            update.std,
            update.kl_divergence,
            selection.map(|_| self.generated_episodes as f64),
            selection.map(|selection| selection.epsilon),
            selection.map(|selection| selection.kept as f64),
            selection.map(|selection| selection.mean_return),
            selection.map(|selection| selection.cvar),
        ]
    }
}

/// Writes both forms.
#[derive(Debug)]
pub struct ProgressLog {
    csv: csv::Writer<File>,
    events: EventWriter,
}

impl ProgressLog {
    /// Creates `progress.csv` and an events file in `directory`. `t_start` is the time of day in seconds since 1970.
    ///
    /// # Errors
    /// The operating system's.
    pub fn create(directory: &Path, t_start: f64) -> std::io::Result<Self> {
        let mut csv = csv::Writer::from_writer(File::create(directory.join("progress.csv"))?);
        csv.write_record(COLUMNS)?;
        csv.flush()?;
        Ok(Self { csv, events: EventWriter::create(directory, t_start)? })
    }

    /// Goes on at the ends of `csv` and of `events`, which is called `events_file`.
    pub(super) fn resume(csv: File, events: File, events_file: String, t_start: f64) -> Self {
        Self { csv: csv::Writer::from_writer(csv), events: EventWriter::resume(events, events_file, t_start) }
    }

    /// The name of the events file.
    pub(super) fn events_file(&self) -> &str {
        self.events.file_name()
    }

    /// Brings what was written to the disk; gives the lengths of `progress.csv` and of the events.
    pub(super) fn sync(&mut self) -> std::io::Result<[u64; 2]> {
        self.csv.flush()?;
        Ok([sync(self.csv.get_ref())?, self.events.sync()?])
    }

    /// Adds a line and an event, and hands them to the operating system. A value that there is not is an empty cell.
    ///
    /// # Errors
    /// The operating system's.
    pub fn write(&mut self, progress: &Progress) -> std::io::Result<()> {
        let values = progress.values();
        self.csv.write_record(values.iter().map(|value| value.map_or_else(String::new, |value| value.to_string())))?;
        self.csv.flush()?;
        let scalars = COLUMNS.iter().zip(values).filter_map(|(name, value)| Some((*name, value?)));
        self.events.write(progress.timesteps, progress.elapsed, scalars)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::algorithm::Selection;

    #[test]
    fn a_line_has_a_value_under_each_name() {
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
            selection: Some(Selection { epsilon: 0.1, kept: 10, kept_steps: 50, mean_return: 7.0, cvar: 3.0 }),
        };
        let progress = Progress {
            iterations: 6,
            timesteps: 700,
            elapsed: 2.0,
            shares: [0.25, 0.5, 1.25],
            episodes: 9,
            generated_episodes: 90,
            saved_timesteps: 0,
            recent: Some([10.0, 11.0, 0.12]),
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
