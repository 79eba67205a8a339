//! The log files of a training. A new training creates them. A resumed training truncates them to their lengths at its
//! checkpoint, and continues them.

use std::fs::{File, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use perturb_checkpoint::EnvironmentSummary;
use perturb_files::{self as files, FileError, io, open_plain, sync_folder};
use serde::{Deserialize, Serialize};

use super::{Clock, Monitor, Progress, ProgressLog};
use crate::client::EndedEpisode;

/// The name of the log of episodes.
const MONITOR: &str = "monitor.csv";
/// The name of the log of updates.
const PROGRESS: &str = "progress.csv";

/// The log files of a training.
#[derive(Debug)]
pub struct Logs {
    directory: PathBuf,
    monitor: Monitor,
    progress: ProgressLog,
}

/// The lengths of the log files in bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogLengths {
    /// Length of `monitor.csv` in bytes.
    pub monitor: u64,
    /// Length of `progress.csv` in bytes.
    pub progress: u64,
    /// Length of the TensorBoard events file in bytes.
    pub events: u64,
    /// Name of the TensorBoard events file.
    pub events_file: String,
}

/// The reason why a log cannot be continued.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LogError {
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A log file has changed since the checkpoint was written.
    #[error(
        "{} has changed since the checkpoint was written: {reason}; put the file back as perturb wrote it, or train \
         again with --overwrite",
        path.display()
    )]
    Changed {
        /// The path of the log file.
        path: PathBuf,
        /// A description of the change.
        reason: String,
    },
}

impl Logs {
    /// Creates the log files in `directory`.
    ///
    /// # Errors
    /// [`FileError`] if a file cannot be created.
    pub fn create(directory: &Path, environment: &str, spec: &EnvironmentSummary, clock: Clock) -> files::Result<Self> {
        let path = directory.join(MONITOR);
        let monitor = Monitor::create(&path, environment, spec, clock).map_err(io("create", &path))?;
        let progress = ProgressLog::create(directory, clock.t_start()).map_err(io("create the logs in", directory))?;
        sync_folder(directory)?; // the names must be on the disk before a checkpoint refers to them
        Ok(Self { directory: directory.to_owned(), monitor, progress })
    }

    /// Opens the log files in `directory`, and truncates them to these `lengths`. New lines are appended there.
    ///
    /// # Errors
    /// [`LogError::Changed`] if a file is missing, is too short, or has no line end at its length; no file is changed
    /// then. [`LogError::File`] if a file cannot be read or written.
    pub fn resume(
        directory: &Path,
        lengths: &LogLengths,
        spec: &EnvironmentSummary,
        clock: Clock,
    ) -> Result<Self, LogError> {
        let events = Path::new(&lengths.events_file).file_name().unwrap_or_default();
        let paths = [directory.join(MONITOR), directory.join(PROGRESS), directory.join(events)];
        let monitor = open(&paths[0], lengths.monitor, true)?;
        let progress = open(&paths[1], lengths.progress, true)?;
        let events = open(&paths[2], lengths.events, false)?;
        let logs = [(&monitor, lengths.monitor), (&progress, lengths.progress), (&events, lengths.events)];
        for ((file, length), path) in logs.into_iter().zip(&paths) {
            file.set_len(length).map_err(io("shorten", path))?;
        }
        let progress = ProgressLog::resume(progress, events, lengths.events_file.clone(), clock.t_start());
        Ok(Self { directory: directory.to_owned(), monitor: Monitor::resume(monitor, spec, clock), progress })
    }

    /// Adds the line of an episode to `monitor.csv`. The line is buffered.
    ///
    /// # Errors
    /// [`FileError`] if the file cannot be written.
    pub fn episode(&mut self, episode: &EndedEpisode) -> files::Result<()> {
        self.monitor.write(episode).map_err(io("write", &self.directory.join(MONITOR)))
    }

    /// Adds a line to `progress.csv`, and an event for TensorBoard. Before that, writes all buffered lines of
    /// `monitor.csv`.
    ///
    /// # Errors
    /// [`FileError`] if a file cannot be written.
    pub fn progress(&mut self, progress: &Progress) -> files::Result<()> {
        self.monitor.flush().map_err(io("write", &self.directory.join(MONITOR)))?;
        self.progress.write(progress).map_err(io("write", &self.directory.join(PROGRESS)))
    }

    /// Flushes all logs to the disk, and returns their lengths.
    ///
    /// # Errors
    /// [`FileError`] if a file cannot be written.
    pub fn sync(&mut self) -> files::Result<LogLengths> {
        let monitor = self.monitor.sync().map_err(io("write", &self.directory.join(MONITOR)))?;
        let [progress, events] = self.progress.sync().map_err(io("write", &self.directory.join(PROGRESS)))?;
        Ok(LogLengths { monitor, progress, events, events_file: self.progress.events_file().to_owned() })
    }
}

/// Opens a log for appending. The file must have at least `length` bytes. If `lines` is set, a line must end after
/// these bytes.
fn open(path: &Path, length: u64, lines: bool) -> Result<File, LogError> {
    let changed = |reason| Err(LogError::Changed { path: path.to_owned(), reason });
    match open_plain(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return changed("it is gone".into()),
        opened => opened.map_err(io("open", path))?,
    };
    let file = OpenOptions::new().read(true).append(true).open(path).map_err(io("open", path))?;
    let got = file.metadata().map_err(io("look at", path))?.len();
    if got < length {
        return changed(format!("it has {got} bytes, but had {length}"));
    }
    let mut last = [b'\n'];
    if lines && length > 0 {
        file.read_exact_at(&mut last, length - 1).map_err(io("read", path))?;
    }
    if last != *b"\n" {
        return changed(format!("its first {length} bytes no longer end with a line"));
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use perturb_policy::ActionKind;

    fn episode(length: u32) -> EndedEpisode {
        EndedEpisode {
            slot: 0,
            environment_index: 0,
            episode_index: 0,
            trial_index: 0,
            episode_in_trial: 0,
            episode_return: 1.5,
            length,
            success: true,
            terminated: true,
            diverged: false,
            achieved: None,
            code_achieved: None,
            receipt: Default::default(),
        }
    }

    fn spec() -> EnvironmentSummary {
        EnvironmentSummary {
            revision: 0,
            step_limit: 200,
            observation: Vec::new(),
            action: ActionKind::Discrete { n: 2 },
            parameters: Vec::new(),
            applied: Vec::new(),
            model_hash: String::new(),
        }
    }

    fn start(directory: &Path) -> Logs {
        Logs::create(directory, "CartPole", &spec(), Clock::new(100.0, 0.0)).unwrap()
    }

    fn read(directory: &Path, name: &str) -> String {
        fs::read_to_string(directory.join(name)).unwrap()
    }

    #[test]
    fn logs_continue_where_they_were_synced() {
        let directory = tempfile::tempdir().unwrap();
        let mut logs = start(directory.path());
        logs.episode(&episode(1)).unwrap();
        let lengths = logs.sync().unwrap();
        assert_eq!(lengths.monitor, read(directory.path(), MONITOR).len() as u64, "all that was written");
        let kept = read(directory.path(), MONITOR);
        logs.episode(&episode(2)).unwrap();
        logs.progress(&Progress::default()).unwrap(); // also writes the buffered lines of `monitor.csv`
        drop(logs);
        assert!(read(directory.path(), MONITOR).len() > kept.len());

        let mut logs = Logs::resume(directory.path(), &lengths, &spec(), Clock::start(7.0)).unwrap();
        assert_eq!(logs.sync().unwrap(), lengths, "what was later is gone");
        logs.episode(&episode(3)).unwrap();
        logs.sync().unwrap();
        let text = read(directory.path(), MONITOR);
        let fields: Vec<&str> = text.strip_prefix(&kept).unwrap().trim_end().split(',').collect();
        assert_eq!(fields[..2], ["1.500000", "3"]);
        assert!((7.0..100.0).contains(&fields[2].parse::<f64>().unwrap()), "seconds go on: {}", fields[2]);
    }

    #[test]
    fn monitor_has_whole_lines_while_a_run_goes_on() {
        let directory = tempfile::tempdir().unwrap();
        let mut logs = start(directory.path());
        assert_eq!(read(directory.path(), MONITOR).lines().count(), 2, "the head is there at once");
        let mut seen = 0;
        for length in 0..4000 {
            logs.episode(&episode(length)).unwrap();
            let text = read(directory.path(), MONITOR);
            if text.len() != seen {
                seen = text.len();
                let last = text.strip_suffix('\n').expect("a whole line").lines().last().unwrap().to_owned();
                assert_eq!(last.split(',').count(), 9, "{last}");
            }
        }
        assert!(seen > 100_000, "lines are written long before the end");
        logs.progress(&Progress::default()).unwrap();
        let text = read(directory.path(), MONITOR);
        assert_eq!(text.lines().count(), 2 + 4000, "each logged iteration has all episodes before it");
        assert!(text.ends_with('\n'));
    }

    #[test]
    fn edited_logs_are_refused_and_left_alone() {
        let directory = tempfile::tempdir().unwrap();
        let mut logs = start(directory.path());
        logs.episode(&episode(1)).unwrap();
        let lengths = logs.sync().unwrap();
        drop(logs);
        let refusal = |name: &str, change: &dyn Fn(&[u8]) -> Vec<u8>| {
            let path = directory.path().join(name);
            let before = fs::read(&path).unwrap();
            let changed = change(&before);
            fs::write(&path, &changed).unwrap();
            let error = Logs::resume(directory.path(), &lengths, &spec(), Clock::start(0.0)).unwrap_err().to_string();
            assert_eq!(fs::read(&path).unwrap(), changed);
            fs::write(&path, before).unwrap();
            assert!(error.contains(&path.display().to_string()), "{error}");
            error
        };
        let shorter = |bytes: &[u8]| bytes[..bytes.len() - 1].to_vec();
        let longer = |bytes: &[u8]| String::from_utf8_lossy(bytes).replace('\n', "\r\n").into_bytes();
        for name in [MONITOR, PROGRESS, "events.out.tfevents.100.perturb"] {
            let expected = |error: &str| error.contains("has changed since") && error.contains("bytes, but had");
            let error = refusal(name, &shorter);
            assert!(expected(&error), "{error}");
        }
        assert!(refusal(MONITOR, &longer).contains("no longer end with a line"));
        fs::remove_file(directory.path().join(PROGRESS)).unwrap();
        let error = Logs::resume(directory.path(), &lengths, &spec(), Clock::start(0.0)).unwrap_err().to_string();
        assert!(error.contains("it is gone") && error.contains(PROGRESS), "{error}");
    }
}
