//! The handle by which a session queues a pipelined step.

use super::job::Job;
use crate::env::EnvironmentSpec;
use bytes::Bytes;
use std::sync::Arc;

/// A handle with which a session queues a step of a batch behind the running step.
pub struct StepQueue {
    pub(super) job: Arc<Job>,
    /// The description of the batch's environment.
    pub spec: &'static EnvironmentSpec,
    /// N, the number of environments in the batch.
    pub size: usize,
}

impl StepQueue {
    /// Queues a step with these actions behind the running step. Does nothing if no step is running, if the step is
    /// just ending, or if the session has not taken the result of the step before it. The caller must have checked the
    /// actions. The batch's next request must be a step with these actions, even if nothing was queued.
    pub fn enqueue(&self, actions: Bytes) {
        // If the lock is taken, a worker is already finishing the running step, and it is too late to queue a step.
        if let Ok(mut pipelined) = self.job.pipelined.try_lock() {
            pipelined.offer(actions);
        }
    }
}
