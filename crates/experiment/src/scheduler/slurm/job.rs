//! The entry of a job in Slurm's queue.

/// States of jobs that have ended and will not run again. A job in any other state is still in the queue.
const ENDED: [&str; 10] = [
    "BOOT_FAIL",
    "CANCELLED",
    "COMPLETED",
    "DEADLINE",
    "FAILED",
    "NODE_FAIL",
    "OUT_OF_MEMORY",
    "PREEMPTED",
    "REVOKED",
    "TIMEOUT",
];

/// A job of an array, as squeue lists it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct QueuedJob {
    /// The number of the job's array.
    pub array: String,
    /// The job's index in the array.
    pub index: usize,
    /// The state, e.g. RUNNING.
    pub state: String,
    /// Slurm's reason for the state, often "None".
    pub reason: String,
    /// The node that runs or ran the job; empty while the job waits.
    pub node: String,
    /// The name of the job's array.
    pub name: String,
}

impl QueuedJob {
    /// Returns the queue entry of a job that was just submitted.
    pub(super) fn pending(array: &str, index: usize, name: &str) -> Self {
        let [array, state, name] = [array, "PENDING", name].map(str::to_owned);
        Self { array, index, state, reason: String::new(), node: String::new(), name }
    }

    /// Returns whether the job runs or will run.
    pub fn is_live(&self) -> bool {
        !ENDED.contains(&self.state.as_str())
    }
}
