//! The queue for a pipelined step.

use super::job::Job;
use crate::env::EnvironmentSpec;
use bytes::Bytes;
use std::sync::Arc;

/// A handle to queue the step that follows the one under way.
pub struct StepQueue {
    pub(super) job: Arc<Job>,
    /// The environment of the batch.
    pub spec: &'static EnvironmentSpec,
    /// N.
    pub size: usize,
}

impl StepQueue {
    /// Queues a step with these actions, which were checked, behind the step under way, if there is one. The batch's
    /// next request must then be that step.
    pub fn enqueue(&self, actions: Bytes) {
        // Who holds it now is at the step's end.
        if let Ok(mut pipelined) = self.job.pipelined.try_lock() {
            pipelined.offer(actions);
        }
    }
}
