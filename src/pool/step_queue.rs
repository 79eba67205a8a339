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
    /// Queues a step with these actions, if a step is running; otherwise does nothing. The caller must have checked the
    /// actions, and must make this step the batch's next request.
    pub fn enqueue(&self, actions: Bytes) {
        // If the lock is taken, a worker is already finishing the running step, and it is too late to queue a step.
        if let Ok(mut pipelined) = self.job.pipelined.try_lock() {
            pipelined.offer(actions);
        }
    }
}
