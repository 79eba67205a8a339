//! Where a session leaves the step that follows the one under way.

use super::job::Job;
use crate::env::EnvironmentSpec;
use bytes::Bytes;
use std::sync::Arc;

/// Where the actions are left of the step that follows the one under way.
pub struct StepQueue {
    pub(super) job: Arc<Job>,
    /// The environments'.
    pub spec: &'static EnvironmentSpec,
    /// N.
    pub size: usize,
}

impl StepQueue {
    /// Has the step that is under way, if one is, be followed by one with these actions, which were checked. The batch's
    /// next request must then be that step.
    pub fn follow(&self, actions: Bytes) {
        // Who holds it now is at the step's end.
        if let Ok(mut follow) = self.job.follow.try_lock() {
            follow.offer(actions);
        }
    }
}
