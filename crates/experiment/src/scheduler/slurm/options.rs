//! Options of runs with Slurm, and their checks before the first submission.

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use super::MAX_CELLS_PER_JOB;

/// Options of a run with Slurm.
#[derive(Clone, Debug)]
pub struct SlurmOptions {
    /// The partition to submit to; `None` for Slurm's default.
    pub partition: Option<String>,
    /// Time limit of each job; `None` for the partition's limit.
    pub time: Option<TimeLimit>,
    /// Maximum number of jobs of an array that run at the same time, at least 1; `None` for no limit.
    pub array_limit: Option<u32>,
    /// Number of cells in a job, 1 to [`MAX_CELLS_PER_JOB`]. If `None`, a job gets cells that take five minutes
    /// together, by estimate.
    pub cells_per_job: Option<usize>,
    /// The command that each job runs.
    pub task: JobCommand,
    /// Interval between requests to Slurm. A cell counts as lost if its job is missing in two answers in a row.
    pub queue_interval: Duration,
}

/// The command that a job runs on its node: `perturb run --cell …`.
#[derive(Clone, Debug)]
pub struct JobCommand {
    /// Absolute path of the program `perturb`. All nodes must see the file.
    pub program: PathBuf,
    /// Number of groups of cells that run in parallel in one job, at least 1.
    pub jobs: usize,
    /// Maximum number of cells in a group, at least 1.
    pub group: usize,
    /// Number of physics threads of each server that the job starts on its node, at least 1. The job starts `jobs`
    /// servers. Unused if `servers` is not empty.
    pub workers: usize,
    /// Absolute paths of task folders that the job's servers also serve.
    pub tasks: Vec<PathBuf>,
    /// Addresses of servers that all jobs share; empty if each job starts its own servers.
    pub servers: Vec<String>,
    /// Time that a job waits for lost servers, in seconds.
    pub server_wait: u32,
}

impl JobCommand {
    /// Returns the number of cores that a job requests from Slurm. A group's learner and its server's first physics
    /// thread run alternately, so they share one core. Each further physics thread gets its own core.
    pub fn cores(&self) -> usize {
        if self.servers.is_empty() { self.jobs.saturating_mul(self.workers) } else { self.jobs }
    }
}

/// The reason why an option of Slurm was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum OptionError {
    /// The time limit has a format that Slurm does not accept.
    #[error(
        "`{got}` is not a time limit: expected minutes, or one of Slurm's other forms MM:SS, HH:MM:SS, DAYS-HH, \
         DAYS-HH:MM, DAYS-HH:MM:SS; it must be more than zero, e.g. 90 or 1-12:00:00"
    )]
    Time { got: String },
    /// The number of cells per job is out of range.
    #[error("{got} cells per job: expected 1 to {MAX_CELLS_PER_JOB}")]
    CellsPerJob { got: usize },
    /// The path has characters that are not allowed in a script or in Slurm's options.
    #[error("{path:?} cannot be handed to Slurm: {reason}; use another folder")]
    Path {
        path: PathBuf,
        /// Description of what is wrong in the path.
        reason: &'static str,
    },
}

impl SlurmOptions {
    /// Checks the number of cells per job and all paths. `folder` is the experiment's folder.
    ///
    /// # Errors
    /// [`OptionError`] for the first invalid option.
    pub fn check(&self, folder: &Path) -> Result<(), OptionError> {
        if let Some(got) = self.cells_per_job.filter(|number| !(1..=MAX_CELLS_PER_JOB).contains(number)) {
            return Err(OptionError::CellsPerJob { got });
        }
        text_of(folder)?;
        text_of(&self.task.program)?;
        self.task.tasks.iter().try_for_each(|task| text_of(task).map(drop))?;
        Ok(())
    }
}

/// Returns a path as text for scripts and Slurm's options. Refuses paths that are relative or that Slurm could misread.
pub(super) fn text_of(path: &Path) -> Result<&str, OptionError> {
    let refuse = |reason| OptionError::Path { path: path.to_owned(), reason };
    let text = path.to_str().ok_or_else(|| refuse("it is not UTF-8"))?;
    if !path.is_absolute() {
        return Err(refuse("it does not begin with /"));
    }
    // In the name of a log file, Slurm gives a backslash a special meaning.
    if text.contains(|character: char| character.is_control() || character == '\\') {
        return Err(refuse("it has a control character or a backslash"));
    }
    Ok(text)
}

/// A time limit in one of Slurm's formats, e.g. `90` (minutes) or `1-12:00:00`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TimeLimit {
    text: String,
    seconds: u64,
}

impl TimeLimit {
    /// Returns the limit as the user wrote it.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Returns the limit in seconds.
    pub fn seconds(&self) -> u64 {
        self.seconds
    }
}

impl FromStr for TimeLimit {
    type Err = OptionError;

    fn from_str(text: &str) -> Result<Self, OptionError> {
        let refuse = || OptionError::Time { got: text.to_owned() };
        let (days, rest) = match text.split_once('-') {
            Some((days, rest)) => (Some(days), rest),
            None => (None, text),
        };
        let number = |part: &str| {
            let digits = !part.is_empty() && part.len() <= 6 && part.bytes().all(|byte| byte.is_ascii_digit());
            digits.then(|| part.parse::<u64>().ok()).flatten().ok_or_else(refuse)
        };
        let parts = rest.split(':').map(number).collect::<Result<Vec<u64>, _>>()?;
        let seconds = match (days.map(number).transpose()?, &parts[..]) {
            (None, [minutes]) => minutes * 60,
            (None, [minutes, seconds]) => minutes * 60 + seconds,
            (None, [hours, minutes, seconds]) => hours * 3600 + minutes * 60 + seconds,
            (Some(days), [hours]) => (days * 24 + hours) * 3600,
            (Some(days), [hours, minutes]) => (days * 24 + hours) * 3600 + minutes * 60,
            (Some(days), [hours, minutes, seconds]) => (days * 24 + hours) * 3600 + minutes * 60 + seconds,
            _ => return Err(refuse()),
        };
        if seconds == 0 {
            return Err(refuse());
        }
        Ok(Self { text: text.to_owned(), seconds })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_limit_has_one_of_slurms_forms() {
        let seconds = |text: &str| text.parse::<TimeLimit>().map(|limit| limit.seconds());
        let known = [
            ("90", 5400),
            ("1:30", 90),
            ("2:00:01", 7201),
            ("1-0", 86_400),
            ("1-12:30", 131_400),
            ("2-00:00:05", 172_805),
        ];
        for (text, expected) in known {
            assert_eq!(seconds(text), Ok(expected), "{text}");
        }
        for text in
            ["", "0", "00:00", "1h", "-5", "1-", "-", "1:2:3:4", "1-2:3:4:5", "1.5", "+5", " 5", "9999999", "1::2"]
        {
            let error = seconds(text).unwrap_err().to_string();
            assert!(error.starts_with(&format!("`{text}` is not a time limit: expected minutes")), "{error}");
        }
        assert_eq!("1-12:30".parse::<TimeLimit>().unwrap().text(), "1-12:30");
    }

    #[test]
    fn paths_that_slurm_could_misread_are_refused() {
        assert_eq!(text_of(Path::new("/shared/it's 100%")), Ok("/shared/it's 100%"));
        for (path, reason) in [("runs/quick", "begin with /"), ("/a\nb", "control character"), ("/a\\b", "backslash")] {
            let error = text_of(Path::new(path)).unwrap_err().to_string();
            assert!(error.contains(reason) && error.contains("use another folder"), "{error}");
        }
    }

    #[test]
    fn a_job_asks_for_the_cores_that_it_uses() {
        let task = JobCommand {
            program: "/x".into(),
            jobs: 2,
            group: 36,
            workers: 3,
            tasks: Vec::new(),
            servers: Vec::new(),
            server_wait: 0,
        };
        assert_eq!(task.cores(), 6);
        assert_eq!(JobCommand { servers: vec!["a:1".into()], ..task }.cores(), 2);
    }
}
