//! The queue for a pipelined step.

use super::job::Job;
use crate::env::EnvironmentSpec;
use bytes::Bytes;
use std::sync::Arc;

/// A handle by which a step can be queued behind the running one.
pub struct StepQueue {
    pub(super) job: Arc<Job>,
    /// The environment of the batch.
    pub spec: &'static EnvironmentSpec,
    /// N.
    pub size: usize,
}

impl StepQueue {
    /// Queues a step with these checked actions behind the running step, if there is one. The batch's next request must
    /// then be that step.
    pub fn enqueue(&self, actions: Bytes) {
        // If the lock is taken, a worker is already ending the step, and it is too late to queue another.
        if let Ok(mut pipelined) = self.job.pipelined.try_lock() {
            pipelined.offer(actions);
        }
    }
}
