//! Writes the log `monitor.csv`, with a line for each training episode.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use perturb_checkpoint::EnvironmentSummary;

use super::Clock;
use super::disk::sync;
use crate::client::EndedEpisode;

/// Number of buffered bytes above which lines are written without waiting for a flush.
const MAX_BUFFERED_BYTES: usize = 64 * 1024;

/// Writes `monitor.csv` in the format of stable-baselines3's Monitor: a line with `#` and JSON, a header, and a line
/// for each episode.
///
/// The columns of Monitor are `r` (return), `l` (length in steps) and `t` (seconds since the start of training).
/// Further columns are `success` and `terminated` (0 or 1), `episode_index`, `environment_index`, `trial_index`,
/// `episode_in_trial`, the requested value of each parameter, and `applied_…` for each value that was read back from
/// the physics.
///
/// Only complete lines are written to the file. A program that reads it during the training, or after the training was
/// killed, therefore never sees a partial line.
#[derive(Debug)]
pub struct Monitor {
    file: File,
    /// Buffer of complete lines that have not been written yet.
    lines: csv::Writer<Vec<u8>>,
    clock: Clock,
    /// Number of `applied_…` columns; 0 if an earlier version of the program created the file without these columns.
    applied: usize,
}

impl Monitor {
    /// Creates the file with its JSON line and its header.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn create(path: &Path, environment: &str, spec: &EnvironmentSummary, clock: Clock) -> std::io::Result<Self> {
        let file = File::create(path)?;
        let mut head = Vec::new();
        writeln!(head, "#{}", serde_json::json!({ "t_start": clock.t_start(), "env_id": environment }))?;
        let mut lines = csv::Writer::from_writer(head);
        let columns = [
            "r",
            "l",
            "t",
            "success",
            "terminated",
            "episode_index",
            "environment_index",
            "trial_index",
            "episode_in_trial",
        ];
        let applied = spec.applied.iter().map(|name| format!("applied_{name}"));
        let of_environment = spec.parameters.iter().cloned().chain(applied);
        lines.write_record(columns.into_iter().map(str::to_owned).chain(of_environment))?;
        let mut monitor = Self { file, lines, clock, applied: spec.applied.len() };
        monitor.flush()?;
        Ok(monitor)
    }

    /// Returns a writer that continues at the end of `file`.
    pub(super) fn resume(file: File, spec: &EnvironmentSummary, clock: Clock) -> Self {
        Self { file, lines: csv::Writer::from_writer(Vec::new()), clock, applied: spec.applied.len() }
    }

    /// Adds the line of an episode.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn write(&mut self, episode: &EndedEpisode) -> std::io::Result<()> {
        let flag = |flag: bool| u8::from(flag).to_string();
        let fixed = [
            format!("{:.6}", episode.episode_return),
            episode.length.to_string(),
            format!("{:.6}", self.clock.elapsed()),
            flag(episode.success),
            flag(episode.terminated),
            episode.episode_index.to_string(),
            episode.environment_index.to_string(),
            episode.trial_index.to_string(),
            episode.episode_in_trial.to_string(),
        ];
        let values = episode
            .receipt
            .requested
            .iter()
            .chain(episode.receipt.applied.iter().take(self.applied))
            .map(f64::to_string);
        self.lines.write_record(fixed.into_iter().chain(values))?;
        if self.lines.get_ref().len() >= MAX_BUFFERED_BYTES { self.flush() } else { Ok(()) }
    }

    /// Writes all buffered lines to the file.
    ///
    /// # Errors
    /// Errors of the operating system.
    pub fn flush(&mut self) -> std::io::Result<()> {
        self.lines.flush()?;
        let lines = std::mem::replace(&mut self.lines, csv::Writer::from_writer(Vec::new()));
        let lines = lines.into_inner().map_err(|error| error.into_error())?;
        if !lines.is_empty() {
            self.file.write_all(&lines)?;
        }
        Ok(())
    }

    /// Flushes the file to the disk and returns its length.
    pub(super) fn sync(&mut self) -> std::io::Result<u64> {
        self.flush()?;
        sync(&self.file, "monitor.csv")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::proto::Receipt;
    use perturb_policy::ActionKind;

    #[test]
    fn file_has_the_format_of_stable_baselines3() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("monitor.csv");
        let spec = EnvironmentSummary {
            revision: 0,
            step_limit: 200,
            observation: Vec::new(),
            action: ActionKind::Discrete { n: 2 },
            parameters: vec!["mass".into(), "length".into()],
            applied: vec!["length".into()],
            model_hash: String::new(),
        };
        let mut monitor = Monitor::create(&path, "CartPole", &spec, Clock::new(12.5, 3.0)).unwrap();
        let episode = EndedEpisode {
            slot: 1,
            environment_index: 3,
            episode_index: 4,
            trial_index: 4,
            episode_in_trial: 0,
            episode_return: 17.5,
            length: 18,
            success: false,
            terminated: true,
            diverged: false,
            achieved: None,
            code_achieved: None,
            receipt: Receipt { requested: vec![0.1, 0.25], applied: vec![0.25], model_hash: String::new() },
        };
        monitor.write(&episode).unwrap();
        monitor.flush().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let first: serde_json::Value = serde_json::from_str(lines[0].strip_prefix('#').unwrap()).unwrap();
        assert_eq!(first, serde_json::json!({ "t_start": 12.5, "env_id": "CartPole" }));
        assert_eq!(
            lines[1],
            "r,l,t,success,terminated,episode_index,environment_index,trial_index,episode_in_trial,mass,length,applied_length"
        );
        let fields: Vec<&str> = lines[2].split(',').collect();
        assert_eq!(fields[..2], ["17.500000", "18"]);
        assert!(fields[2].parse::<f64>().unwrap() >= 3.0);
        assert_eq!(fields[3..], ["0", "1", "4", "3", "4", "0", "0.1", "0.25", "0.25"]);
        assert_eq!(lines.len(), 3);
    }
}
