//! A job in Slurm's queue.

/// States of jobs that will not run again; in every other state a job is in the queue still.
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

/// A job of an array, as squeue shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct QueuedJob {
    /// The array's number.
    pub array: String,
    /// The job's index in it.
    pub index: usize,
    /// The state, e.g. RUNNING.
    pub state: String,
    /// Why it is in this state; "None" often.
    pub reason: String,
    /// The node that runs or ran the job; empty while it waits.
    pub node: String,
    /// The array's name.
    pub name: String,
}

impl QueuedJob {
    /// Returns a job that was just submitted.
    pub(super) fn pending(array: &str, index: usize, name: &str) -> Self {
        let [array, state, name] = [array, "PENDING", name].map(str::to_owned);
        Self { array, index, state, reason: String::new(), node: String::new(), name }
    }

    /// Whether it runs, or will.
    pub fn is_live(&self) -> bool {
        !ENDED.contains(&self.state.as_str())
    }
}
