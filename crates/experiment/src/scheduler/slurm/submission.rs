//! Reads and writes submissions in the experiment's folder. A submission is one Slurm job array with its plan and its
//! cells.

use std::path::{Path, PathBuf};

use perturb_files::{self as files, write_atomically, write_json};
use serde::{Deserialize, Serialize};

use super::job::QueuedJob;
use crate::folder;
use crate::folder::{ExperimentFolder, FolderError};
use crate::plan::Plan;

/// The file with the cell ids of each job, one job per line.
const CELLS: &str = "cells.txt";
/// The file with the names that Slurm knows the submission by.
const DOCUMENT: &str = "submission.json";

/// A job array that was submitted to Slurm, or prepared for it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Submission {
    /// Number of the submission, from 1.
    pub(super) number: u32,
    /// The folder of the submission.
    pub(super) path: PathBuf,
    /// The ids of each job's cells, by the job's index in the array.
    pub(super) jobs: Vec<Vec<String>>,
    /// The array's name and, once known, its number in Slurm.
    pub(super) names: SlurmNames,
}

/// The content of `submission.json`: how to find the array in Slurm's queue.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SlurmNames {
    /// The array's name in the queue, chosen before the submission. If this process ends before Slurm returns the
    /// array's number, the next process finds the array by its name.
    pub(super) name: String,
    /// The array's number; `None` until Slurm has returned it.
    pub(super) job: Option<String>,
}

/// Maximum size of a submission's list of cells, in bytes.
const MAX_CELLS_BYTES: u64 = 64 << 20;

/// Returns the folder of all submissions.
pub(super) fn directory(folder: &ExperimentFolder) -> PathBuf {
    folder.path().join("slurm")
}

/// Reads all complete submissions, oldest first.
pub(super) fn list(folder: &ExperimentFolder) -> Result<Vec<Submission>, FolderError> {
    let directory = directory(folder);
    let mut submissions = Vec::new();
    for number in numbers(&directory)? {
        submissions.extend(read(&directory.join(number.to_string()), number)?);
    }
    Ok(submissions)
}

/// Returns the numbers of all submissions in ascending order, including incomplete ones.
fn numbers(directory: &Path) -> files::Result<Vec<u32>> {
    let paths = files::list(directory)?;
    let mut numbers: Vec<u32> = paths.iter().filter_map(|path| path.file_name()?.to_str()?.parse().ok()).collect();
    numbers.sort_unstable();
    Ok(numbers)
}

/// Reads the submission in `path`. Returns `None` if it is incomplete, because its preparation was interrupted before
/// it was sent to Slurm.
fn read(path: &Path, number: u32) -> Result<Option<Submission>, FolderError> {
    let Some(names) = folder::read(&path.join(DOCUMENT))? else { return Ok(None) };
    let text = files::read_plain_text(&path.join(CELLS), MAX_CELLS_BYTES)?;
    let jobs = text.lines().map(|line| line.split(',').map(str::to_owned).collect()).collect();
    Ok(Some(Submission { number, path: path.to_owned(), jobs, names }))
}

/// Writes the files of a new submission, which can then be sent to Slurm. Writes `submission.json` last, which makes
/// the submission complete. `script` returns the job script, given the folder of the submission.
pub(super) fn create(
    folder: &ExperimentFolder,
    plan: &Plan,
    jobs: Vec<Vec<String>>,
    script: &dyn Fn(&Path) -> Result<String, super::SlurmError>,
) -> Result<Submission, super::SlurmError> {
    let directory = directory(folder);
    let number = numbers(&directory)?.last().map_or(1, |last| last + 1);
    let path = directory.join(number.to_string());
    let lines: String = jobs.iter().map(|cells| cells.join(",") + "\n").collect();
    plan.files().try_for_each(|(name, content)| write_atomically(&path.join(name), content))?;
    write_atomically(&path.join(CELLS), lines.as_bytes())?;
    write_atomically(&path.join("job.sh"), script(&path)?.as_bytes())?;
    // The hash of the path makes names of different folders differ in the same queue.
    let place = crc32c::crc32c(path.as_os_str().as_encoded_bytes());
    let names = SlurmNames { name: format!("perturb-{place:08x}-{number}"), job: None };
    let submission = Submission { number, path, jobs, names };
    submission.write()?;
    Ok(submission)
}

impl Submission {
    /// Stores the array's number that Slurm returned.
    pub(super) fn accepted(&mut self, job: &str) -> files::Result<()> {
        self.names.job = Some(job.to_owned());
        self.write()
    }

    /// Returns whether `job` belongs to this array.
    pub(super) fn has(&self, job: &QueuedJob) -> bool {
        job.name == self.names.name && self.names.job.as_ref().is_none_or(|array| *array == job.array)
    }

    /// Returns the path of the event file of job `index`, with one JSON event per line.
    pub(super) fn events(&self, index: usize) -> PathBuf {
        self.path.join(format!("{index}.jsonl"))
    }

    /// Returns the path of the log of job `index`.
    pub(super) fn log(&self, index: usize) -> PathBuf {
        self.path.join(format!("{index}.log"))
    }

    /// Deletes the files of a submission that Slurm refused.
    pub(super) fn forget(&self) -> files::Result<()> {
        files::delete(&self.path)
    }

    fn write(&self) -> files::Result<()> {
        write_json(&self.path.join(DOCUMENT), &self.names)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn submissions_are_numbered_and_read_back() {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        assert!(list(&folder).unwrap().is_empty());
        let jobs = |ids: &[&[&str]]| -> Vec<Vec<String>> {
            ids.iter().map(|job| job.iter().map(|id| (*id).to_owned()).collect()).collect()
        };
        let plan = "environments = ['Hopper']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
        let plan = Plan::parse("test", plan.into()).unwrap();
        let script = |_: &Path| Ok("#!/bin/sh\n".to_owned());
        let mut first = create(&folder, &plan, jobs(&[&["a", "b"], &["c"]]), &script).unwrap();
        // The preparation of submission 2 was interrupted. Its number is not used again.
        fs::create_dir(super::directory(&folder).join("2")).unwrap();
        let third = create(&folder, &plan, jobs(&[&["d"]]), &script).unwrap();
        assert_eq!(third.number, 3);
        assert_ne!(first.names.name, third.names.name);
        first.accepted("17").unwrap();
        assert_eq!(list(&folder).unwrap(), [first.clone(), third.clone()]);
        assert_eq!(fs::read_to_string(first.path.join("cells.txt")).unwrap(), "a,b\nc\n");
        third.forget().unwrap();
        assert_eq!(list(&folder).unwrap(), [first.clone()]);
        fs::write(first.path.join("submission.json"), "{").unwrap();
        assert!(list(&folder).unwrap_err().to_string().contains("submission.json is not understood"));
    }
}
