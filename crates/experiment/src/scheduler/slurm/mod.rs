//! Runs a plan's cells as jobs of Slurm, in a folder that all its nodes can read and write.
//!
//! Results in the folder alone decide which cells are done. Slurm only tells which of the other cells are still in its
//! queue. The remaining cells are submitted as an array, whose jobs each run several cells of one kind in groups. So a
//! watching process has no state that a later one would need. A lost node, a time limit or a cancelled job is noticed by the
//! next process that watches.
//!
//! ```text
//! DIR/slurm/lock               locked while one of several watching processes decides and submits
//! DIR/slurm/N/plan.toml        the plan of the Nth submission
//! DIR/slurm/N/cells.txt        line K+1: the cells of job K of its array, separated by commas
//! DIR/slurm/N/job.sh           what every job of the array runs
//! DIR/slurm/N/submission.json  the name in Slurm's queue and, once it is accepted, the number
//! DIR/slurm/N/K.log            what job K said
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

/// Maximum number of cells of a job. Their ids must fit in one argument of a command, which Linux limits to 128 KiB.
pub const MAX_CELLS_PER_JOB: usize = 1000;

#[cfg(test)]
mod tests;
