//! Pipelined steps. A client may request a step while another step is running. This pipelined step starts as soon as
//! the running step ends, before the session has been woken to answer the request of the running step.

use super::{
    shard::{Shard, set_actions},
    step_result::{ShardOutputs, StepResult},
};
use bytes::{Bytes, BytesMut};
use std::sync::Mutex;
use tokio::time::Instant;

/// The state of a job's pipelined step.
#[derive(Default)]
pub(super) struct PipelinedStep {
    /// Whether a step is running. The worker that finishes the step checks for a pipelined step.
    is_under_way: bool,
    /// The actions of the pipelined step, if one is queued.
    actions: Option<Bytes>,
    /// The result and end time of the step before the pipelined step. `None` after the session has taken result and
    /// time.
    result: Option<(StepResult, Instant)>,
    /// The time at which a step last ended without a pipelined step in the queue.
    ended: Option<Instant>,
    buffer: BytesMut,
    reward_terms: bool,
}

impl PipelinedStep {
    /// Makes the state without a pipelined step. `reward_terms` says whether step results contain the terms of the
    /// reward.
    pub(super) fn new(reward_terms: bool) -> Self {
        Self { reward_terms, ..Self::default() }
    }

    /// Records that a step starts.
    pub(super) fn begin(&mut self) {
        self.is_under_way = true;
    }

    /// Called after a step. If a pipelined step is queued, stores the result of the ended step and gives the shards the
    /// next actions. Returns whether a step was queued.
    pub(super) fn after_step(&mut self, shards: &[Mutex<Shard>]) -> bool {
        let Some(actions) = self.actions.take() else {
            (self.is_under_way, self.ended) = (false, Some(Instant::now()));
            return false;
        };
        let result = ShardOutputs { shards, buffer: &mut self.buffer }.step_result(self.reward_terms);
        set_actions(shards, &actions);
        self.result = Some((result, Instant::now()));
        true
    }

    /// Drops the queued step, and accepts no other queued step until the next step starts.
    pub(super) fn stop(&mut self) {
        (self.is_under_way, self.actions) = (false, None);
    }

    /// Takes the result and the end time of the step before the pipelined step. Returns `None` if no pipelined step was
    /// queued.
    pub(super) fn take_result(&mut self) -> Option<(StepResult, Instant)> {
        self.result.take()
    }

    /// The time at which a step last ended without a pipelined step in the queue.
    pub(super) fn ended_at(&self) -> Option<Instant> {
        self.ended
    }

    /// Queues a step with these actions, if a step is running and the session has taken the previous result.
    pub(super) fn offer(&mut self, actions: Bytes) {
        if self.is_under_way && self.result.is_none() {
            self.actions = Some(actions);
        }
    }
}
