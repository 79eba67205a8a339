//! Doing a plan's cells as jobs of Slurm, over a folder that all its nodes see.
//!
//! The folder says what is done, whatever Slurm says. Slurm is asked for one thing only: which of the cells without a
//! result are still in its queue. The others are submitted, as an array whose jobs do several cells of one kind each, in
//! groups. So a watching process remembers nothing that a later one would need, and what happens while nobody watches is
//! noticed later: a node that was lost, a time limit, a job that was cancelled.
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

/// The most cells of a job: their ids must fit in one argument of a command, which Linux limits to 128 KiB.
pub const MAX_CELLS_PER_JOB: usize = 1000;

#[cfg(test)]
mod tests;
