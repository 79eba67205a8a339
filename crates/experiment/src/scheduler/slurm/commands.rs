//! Calls Slurm's commands and parses their output.

use std::ffi::OsStr;
use std::fs::File;
use std::io::{Read, Seek};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_files::temporary_file;

use super::error::SlurmError;
use super::job::QueuedJob;
use super::options::{OptionError, SlurmOptions, text_of};
use super::submission::Submission;

/// Timeout of a Slurm command.
const LIMIT: Duration = Duration::from_secs(60);
/// Interval between checks whether a command has ended.
const TICK: Duration = Duration::from_millis(20);
/// Output format of squeue: array, index, state, reason, node and name of a job.
const FIELDS: &str = "%F|%K|%T|%r|%N|%j";
/// Separator of the fields in a line of squeue.
const SEPARATOR: char = '|';
/// Prefix of heading lines in squeue's output. With several clusters, squeue prints a heading above each cluster's
/// jobs, even with --noheader.
const CLUSTER_HEADING: &str = "CLUSTER:";

/// The commands of the Slurm installation on this machine.
#[derive(Clone, Debug)]
pub struct Slurm {
    directory: Option<PathBuf>,
    limit: Duration,
}

impl Default for Slurm {
    fn default() -> Self {
        Self { directory: None, limit: LIMIT }
    }
}

impl Slurm {
    /// Uses the commands in `directory` instead of the commands on the PATH. `limit` is the timeout of each command.
    pub fn in_directory(directory: PathBuf, limit: Duration) -> Self {
        Self { directory: Some(directory), limit }
    }

    /// Checks that Slurm's commands work on this machine.
    ///
    /// # Errors
    /// [`SlurmError::NotInstalled`], or an error of a command.
    pub fn check(&self, stop: &StopFlag) -> Result<(), SlurmError> {
        ["sbatch", "squeue", "scontrol"].into_iter().try_for_each(|name| self.call(name, ["--version"], stop).map(drop))
    }

    /// Asks Slurm for the jobs of the arrays with these names. Includes jobs that ended a short time ago.
    ///
    /// # Errors
    /// [`SlurmError`] if squeue fails or does not answer in time.
    pub(super) fn queue(&self, names: &[&str], stop: &StopFlag) -> Result<QueueAnswer, SlurmError> {
        if names.is_empty() {
            return Ok(QueueAnswer::default());
        }
        let names = format!("--name={}", names.join(","));
        let format = format!("--format={FIELDS}");
        let text = self.call("squeue", ["--array", "--noheader", "--states=all", &format, &names], stop)?;
        QueueAnswer::parse(&text)
    }

    /// Asks Slurm for the maximum number of jobs in an array.
    ///
    /// # Errors
    /// [`SlurmError`] if scontrol fails or does not answer in time, or arrays are disabled.
    pub(super) fn max_jobs(&self, stop: &StopFlag) -> Result<usize, SlurmError> {
        let text = self.call("scontrol", ["show", "config"], stop)?;
        match parse_setting(&text, "MaxArraySize").map(str::parse::<usize>) {
            Some(Ok(0)) => Err(SlurmError::NoArrays),
            Some(Ok(number)) => Ok(number),
            _ => Err(not_understood("scontrol", "a line MaxArraySize = NUMBER", &text)),
        }
    }

    /// Submits an array and returns its number. Signals do not interrupt the command, because it would then be unknown
    /// whether Slurm accepted the array.
    ///
    /// # Errors
    /// [`SlurmError`] if sbatch fails or does not answer in time.
    pub(super) fn submit(&self, submission: &Submission, options: &SlurmOptions) -> Result<String, SlurmError> {
        let arguments = sbatch_arguments(submission, options)?;
        let text = self.call("sbatch", &arguments, &StopFlag::default())?;
        // With several clusters the format is NUMBER;CLUSTER. Plugins may print other lines.
        let number = text.lines().rev().find_map(|line| {
            let number = line.trim().split(';').next().unwrap_or_default();
            number.parse::<u64>().ok().map(|_| number.to_owned())
        });
        number.ok_or_else(|| not_understood("sbatch", "the number of a job", &text))
    }

    /// Runs a command until it ends, and returns its standard output. Kills it after the timeout, or when `stop` is
    /// raised.
    fn call<S: AsRef<OsStr>>(
        &self,
        name: &'static str,
        arguments: impl IntoIterator<Item = S>,
        stop: &StopFlag,
    ) -> Result<String, SlurmError> {
        let program = self.directory.as_ref().map_or_else(|| PathBuf::from(name), |directory| directory.join(name));
        let failed = |source| SlurmError::System { program: name, source };
        // Output goes to files, because a full pipe would block the command while nobody reads it.
        let (mut output, mut errors) = (temporary_file().map_err(failed)?, temporary_file().map_err(failed)?);
        let mut command = Command::new(program);
        command.args(arguments).stdin(Stdio::null());
        command.stdout(output.try_clone().map_err(failed)?).stderr(errors.try_clone().map_err(failed)?);
        // A user's default filters for squeue would hide jobs, so they are removed. Defaults for sbatch, such as
        // account and memory, are kept.
        for (key, _) in std::env::vars_os().filter(|(key, _)| key.to_string_lossy().starts_with("SQUEUE_")) {
            command.env_remove(key);
        }
        let mut child = command.spawn().map_err(|source| match source.kind() {
            std::io::ErrorKind::NotFound => SlurmError::NotInstalled { program: name },
            _ => failed(source),
        })?;
        let start = Instant::now();
        let status = loop {
            if let Some(status) = child.try_wait().map_err(failed)? {
                break status;
            }
            let stopped = stop.signal().is_some();
            if stopped || start.elapsed() >= self.limit {
                let _ = child.kill(); // an error means that it has already ended
                let _ = child.wait();
                return Err(SlurmError::Silent { program: name, limit: start.elapsed().min(self.limit) });
            }
            std::thread::sleep(TICK);
        };
        let (output, words) = (content(&mut output).map_err(failed)?, content(&mut errors).map_err(failed)?);
        if status.success() {
            return Ok(output);
        }
        let words = if words.trim().is_empty() { output } else { words };
        let words = if words.trim().is_empty() { status.to_string() } else { words.trim().to_owned() };
        Err(SlurmError::Refused { program: name, words })
    }
}

/// Reads a file from its start as text.
fn content(file: &mut File) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    file.rewind()?;
    file.read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// Returns the arguments of `sbatch` for a submission.
fn sbatch_arguments(submission: &Submission, options: &SlurmOptions) -> Result<Vec<String>, OptionError> {
    let limit = options.array_limit.map_or_else(String::new, |limit| format!("%{limit}"));
    let path = text_of(&submission.path)?;
    let mut arguments = vec![
        "--parsable".to_owned(),
        format!("--job-name={}", submission.names.name),
        format!("--array=0-{}{limit}", submission.jobs.len().saturating_sub(1)),
        "--nodes=1".to_owned(),
        "--ntasks=1".to_owned(),
        format!("--cpus-per-task={}", options.task.cores()),
        "--requeue".to_owned(), // Slurm queues the jobs of a lost node again, even if no `perturb run` is watching
        format!("--chdir={path}"),
        format!("--output={}/%a.jsonl", path.replace('%', "%%")),
        format!("--error={}/%a.log", path.replace('%', "%%")),
        "--open-mode=append".to_owned(),
    ];
    arguments.extend(options.partition.as_ref().map(|name| format!("--partition={name}")));
    arguments.extend(options.time.as_ref().map(|limit| format!("--time={}", limit.text())));
    arguments.push(text_of(&submission.path.join("job.sh"))?.to_owned());
    Ok(arguments)
}

/// The parsed output of squeue.
#[derive(Debug, Default)]
pub(super) struct QueueAnswer {
    pub(super) jobs: Vec<QueuedJob>,
    /// Output lines that are not jobs, for example from a site's wrapper or plugin.
    pub(super) foreign: Vec<String>,
}

impl QueueAnswer {
    /// Parses the output of squeue. Separates jobs from other lines.
    fn parse(text: &str) -> Result<Self, SlurmError> {
        let mut answer = Self::default();
        for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
            // A banner may contain the separator, too. A line counts as a job only if it has a separator and begins
            // with a digit. A failure to parse such a line is an error.
            let first = line.split_once(SEPARATOR).map(|(first, _)| first.trim());
            if first.is_some_and(|first| first.starts_with(|c: char| c.is_ascii_digit())) {
                answer.jobs.push(parse_job(line)?);
            } else if !line.starts_with(CLUSTER_HEADING) {
                answer.foreign.push(line.to_owned());
            }
        }
        Ok(answer)
    }
}

/// Parses a line of squeue in the format [`FIELDS`].
fn parse_job(line: &str) -> Result<QueuedJob, SlurmError> {
    let fields: Vec<&str> = line.trim().split(SEPARATOR).map(str::trim).collect();
    let [array, index, state, reason, node, name] = fields[..] else {
        return Err(not_understood("squeue", FIELDS, line));
    };
    // After the state CANCELLED, squeue may print the number of the user who cancelled the job.
    let state = state.split([' ', '+']).next().unwrap_or_default();
    let index = index.parse().map_err(|_| not_understood("squeue", "an index of an array", line))?;
    let [array, state, reason, node, name] = [array, state, reason, node, name].map(str::to_owned);
    Ok(QueuedJob { array, index, state, reason, node, name })
}

/// Returns the value of `KEY = VALUE` in the output of `scontrol show config`.
fn parse_setting<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    text.lines().find_map(|line| {
        let (name, value) = line.split_once('=')?;
        (name.trim() == key).then(|| value.trim())
    })
}

/// Returns the error for unexpected output of a Slurm program, with the first 200 characters of the output.
fn not_understood(program: &'static str, expected: &'static str, got: &str) -> SlurmError {
    let got: String = got.trim().chars().take(200).collect();
    SlurmError::NotUnderstood { program, expected, got }
}

#[cfg(test)]
mod tests {
    use super::super::submission::SlurmNames;
    use super::super::tests::options;
    use super::*;

    #[test]
    fn squeues_lines_are_understood() {
        let job = parse_job("17|3|PENDING|Resources||perturb-0-1").unwrap();
        assert_eq!((job.array.as_str(), job.index, job.reason.as_str(), job.node.as_str()), ("17", 3, "Resources", ""));
        assert!(job.is_live());
        for (state, live) in [("RUNNING", true), ("COMPLETING", true), ("REQUEUED", true), ("NODE_FAIL", false)] {
            assert_eq!(parse_job(&format!("17|3|{state}|None|n1|x")).unwrap().is_live(), live, "{state}");
        }
        assert_eq!(parse_job("1|0|CANCELLED by 0|None|n1|x").unwrap().state, "CANCELLED");
        for line in ["17|3|RUNNING", "17|N/A|RUNNING|None|n1|x"] {
            let error = parse_job(line).unwrap_err().to_string();
            assert!(error.contains("squeue") && error.contains(line), "{error}");
        }
    }

    #[test]
    fn lines_that_are_no_jobs_are_passed_over() {
        let text = "Maintenance on Monday\nCLUSTER: alpha\n17|3|RUNNING|None|n1|x\n\nCLUSTER: beta\n";
        let QueueAnswer { jobs, foreign } = QueueAnswer::parse(text).unwrap();
        assert_eq!((jobs.len(), jobs[0].index, foreign), (1, 3, vec!["Maintenance on Monday".to_owned()]));
        assert!(QueueAnswer::parse("CLUSTER: alpha\n").unwrap().jobs.is_empty());
        let banner = "| Welcome | to the cluster |\nNote 7 | see the wiki\n17|3|RUNNING|None|n1|x\n";
        let QueueAnswer { jobs, foreign } = QueueAnswer::parse(banner).unwrap();
        assert_eq!((jobs.len(), foreign.len()), (1, 2));
        assert!(QueueAnswer::parse("17|3|RUNNING\n").is_err() && QueueAnswer::parse("17_3|RUNNING|x\n").is_err());
    }

    #[test]
    fn scontrols_settings_are_understood() {
        let text = "MaxArraySize            = 1001\nMaxArraySizeOther = 3\nX\n";
        assert_eq!(parse_setting(text, "MaxArraySize"), Some("1001"));
        assert_eq!(parse_setting(text, "MaxArray"), None);
    }

    #[test]
    fn sbatch_gets_all_requested_options() {
        let mut options = options();
        let names = SlurmNames { name: "perturb-x-1".into(), job: None };
        let jobs = vec![vec!["a".into()]; 3];
        let submission = Submission { number: 1, path: "/shared/100%/slurm/1".into(), jobs, names };
        let text = sbatch_arguments(&submission, &options).unwrap().join(" ");
        let expected = "--array=0-2 --nodes=1 --ntasks=1 --cpus-per-task=1 --requeue --chdir=/shared/100%/slurm/1 \
                        --output=/shared/100%%/slurm/1/%a.jsonl \
                        --error=/shared/100%%/slurm/1/%a.log --open-mode=append /shared/100%/slurm/1/job.sh";
        assert!(text.ends_with(expected), "{text}");
        options.partition = Some("long".into());
        options.time = Some("1-00".parse().unwrap());
        options.array_limit = Some(2);
        let text = sbatch_arguments(&submission, &options).unwrap().join(" ");
        assert!(text.contains("--array=0-2%2 ") && text.contains(" --partition=long --time=1-00 /shared"), "{text}");
    }
}
