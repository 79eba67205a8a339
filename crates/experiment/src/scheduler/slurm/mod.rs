//! Runs a plan's cells as Slurm jobs. All nodes must be able to read and write the experiment's folder.
//!
//! A cell is done when its result is in the folder. The process that watches the run asks Slurm which of the other
//! cells are still in its queue, and submits the remaining cells as a job array. Each job of the array runs several
//! cells of one kind in groups. All state is in the folder and in Slurm's queue, so the watching process may end, and a
//! later one continues. The later process also notices lost nodes, exceeded time limits and cancelled jobs.
//!
//! ```text
//! DIR/slurm/lock               locked by the process that decides what to submit
//! DIR/slurm/N/plan.toml        the plan of submission N; its CSV files are in the same folder
//! DIR/slurm/N/cells.txt        line K+1: the cells of job K of the array, separated by commas
//! DIR/slurm/N/job.sh           the script that every job of the array runs
//! DIR/slurm/N/submission.json  the array's name in Slurm's queue and, once accepted, its number
//! DIR/slurm/N/K.jsonl          standard output of job K: its events, one per line
//! DIR/slurm/N/K.log            standard error of job K
//! ```

mod batch;
mod commands;
mod error;
mod job;
mod jobs;
mod options;
mod script;
mod submission;

pub use commands::Slurm;
pub use error::SlurmError;
pub use job::QueuedJob;
pub use jobs::Jobs;
pub use options::{JobCommand, OptionError, SlurmOptions, TimeLimit};

/// Maximum number of cells in a job. The ids of a job's cells must fit in one command-line argument, which Linux limits
/// to 128 KiB.
pub const MAX_CELLS_PER_JOB: usize = 1000;

#[cfg(test)]
mod tests;
