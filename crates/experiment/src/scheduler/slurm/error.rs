//! Errors of running cells with Slurm.

use std::time::Duration;

use perturb_files::{AnyError, FileError};

use super::super::count;
use super::options::OptionError;
use crate::folder::FolderError;

/// The reason why cells cannot be run with Slurm.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum SlurmError {
    /// Slurm's commands are not on the PATH.
    #[error("there is no `{program}` here: start this on a machine that submits to Slurm, or install slurm-client")]
    NotInstalled { program: &'static str },
    /// A command could not be run.
    #[error("cannot run {program}: {source}")]
    System { program: &'static str, source: std::io::Error },
    /// A command ended with an error.
    #[error("{program} refused: {words}")]
    Refused { program: &'static str, words: String },
    /// A command did not answer in time.
    #[error("{program} did not answer within {} s; is Slurm's controller up? The same command resumes", limit.as_secs())]
    Silent {
        program: &'static str,
        /// The time after which the command was killed.
        limit: Duration,
    },
    /// A command's output does not have the expected format.
    #[error("{program} printed `{got}`, expected {expected}")]
    NotUnderstood { program: &'static str, expected: &'static str, got: String },
    /// This Slurm is configured without job arrays.
    #[error(
        "Slurm is configured without job arrays (MaxArraySize = 0), which --engine slurm needs; use `perturb \
         run --cell`"
    )]
    NoArrays,
    /// An option was refused.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The folder cannot be read or written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The cost of cells cannot be estimated.
    #[error("cannot estimate how long cells take, which is needed to size jobs: {0}; pass --cells-per-job")]
    Cost(AnyError),
    /// The jobs of all unfinished cells were cancelled.
    #[error(
        "Slurm job {} was cancelled; the same command submits the unfinished cells again: {}",
        arrays.join(", "),
        count(*missing, "cell")
    )]
    Cancelled {
        arrays: Vec<String>,
        /// The number of cells without a result.
        missing: usize,
    },
}
