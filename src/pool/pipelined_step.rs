//! A pipelined step is requested while another one runs. It begins as soon as that step ends, while the session is
//! still being woken to answer the first request.

use super::{
    shard::{Shard, set_actions},
    step_result::{ShardOutputs, StepResult},
};
use bytes::{Bytes, BytesMut};
use std::sync::Mutex;
use tokio::time::Instant;

/// The pipelined step of a job.
#[derive(Default)]
pub(super) struct PipelinedStep {
    /// Whether a step is running that a pipelined step may follow. The last worker of the running step checks for one.
    is_under_way: bool,
    /// The next step's actions.
    actions: Option<Bytes>,
    /// Result and completion time of the step before the running one, until the session collects it.
    result: Option<(StepResult, Instant)>,
    /// The end time of the last step that no pipelined step followed.
    ended: Option<Instant>,
    buffer: BytesMut,
    reward_terms: bool,
}

impl PipelinedStep {
    /// Makes the state without a pipelined step. `reward_terms` says whether steps report the reward's terms.
    pub(super) fn new(reward_terms: bool) -> Self {
        Self { reward_terms, ..Self::default() }
    }

    /// Records that a step begins.
    pub(super) fn begin(&mut self) {
        self.is_under_way = true;
    }

    /// Ends a step. If another one is queued, stores the result and gives the shards their next actions. Returns
    /// whether one was queued.
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

    /// Drops the queued step.
    pub(super) fn stop(&mut self) {
        (self.is_under_way, self.actions) = (false, None);
    }

    /// Takes the result and the end time of the last step, if a pipelined step has followed it.
    pub(super) fn take_result(&mut self) -> Option<(StepResult, Instant)> {
        self.result.take()
    }

    /// The end time of the last step that no pipelined step followed.
    pub(super) fn ended_at(&self) -> Option<Instant> {
        self.ended
    }

    /// Queues a step with these actions, if a step runs and its result is not stored yet.
    pub(super) fn offer(&mut self, actions: Bytes) {
        if self.is_under_way && self.result.is_none() {
            self.actions = Some(actions);
        }
    }
}
