//! A pipelined step is requested while another is under way. It begins as soon as that ends, while the session, which
//! has to answer the first, is still being woken.

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
    /// A step is under way, and its worker will look here at its end.
    is_under_way: bool,
    /// The next step's actions.
    actions: Option<Bytes>,
    /// Result and completion time of the step before the running one, until the session collects it.
    result: Option<(StepResult, Instant)>,
    /// The time at which the last step ended that no other followed.
    ended: Option<Instant>,
    buffer: BytesMut,
    reward_terms: bool,
}

impl PipelinedStep {
    /// No pipelined step, of a job whose steps report the reward's terms or not.
    pub(super) fn new(reward_terms: bool) -> Self {
        Self { reward_terms, ..Self::default() }
    }

    /// Notes that a step begins.
    pub(super) fn begin(&mut self) {
        self.is_under_way = true;
    }

    /// At the end of a step: if another is queued, keeps the result and gives the shards their next actions. Returns
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

    /// Takes result and completion time of the last step, if another has begun since.
    pub(super) fn take_result(&mut self) -> Option<(StepResult, Instant)> {
        self.result.take()
    }

    /// The time at which the last step ended, if no other followed.
    pub(super) fn ended_at(&self) -> Option<Instant> {
        self.ended
    }

    /// Keeps the actions of the step that is to follow, if one can.
    pub(super) fn offer(&mut self, actions: Bytes) {
        if self.is_under_way && self.result.is_none() {
            self.actions = Some(actions);
        }
    }
}
