//! The step that was asked for while another was under way: it begins as soon as that ends, while the session, which has
//! to tell of the first, is still being woken.

use super::{
    shard::{Shard, put_actions},
    step_result::{ShardOutputs, StepResult},
};
use bytes::{Bytes, BytesMut};
use std::sync::Mutex;
use tokio::time::Instant;

/// What follows the step of a job that is under way.
#[derive(Default)]
pub(super) struct PipelinedStep {
    /// A step is under way, and its worker will look here at its end.
    is_under_way: bool,
    /// The next step's actions.
    actions: Option<Bytes>,
    /// What came of the step whose end began the present one, until the session takes it, and when that was.
    stepped: Option<(StepResult, Instant)>,
    /// When the last step ended that none followed.
    ended: Option<Instant>,
    buffer: BytesMut,
    reward_terms: bool,
}

impl PipelinedStep {
    /// Of a job whose steps tell of the reward's terms, or not.
    pub(super) fn new(reward_terms: bool) -> Self {
        Self { reward_terms, ..Self::default() }
    }

    /// A step begins.
    pub(super) fn begin(&mut self) {
        self.is_under_way = true;
    }

    /// At the end of a step: takes what came of it and gives the shards their next actions, if there are some.
    pub(super) fn go_on(&mut self, shards: &[Mutex<Shard>]) -> bool {
        let Some(actions) = self.actions.take() else {
            (self.is_under_way, self.ended) = (false, Some(Instant::now()));
            return false;
        };
        let stepped = ShardOutputs { shards, buffer: &mut self.buffer }.stepped(self.reward_terms);
        put_actions(shards, &actions);
        self.stepped = Some((stepped, Instant::now()));
        true
    }

    /// Nothing is to follow the step that is under way.
    pub(super) fn stop(&mut self) {
        (self.is_under_way, self.actions) = (false, None);
    }

    /// What came of the last step, if another has begun since, and when.
    pub(super) fn take(&mut self) -> Option<(StepResult, Instant)> {
        self.stepped.take()
    }

    /// When the last step ended, if no other followed.
    pub(super) fn ended(&self) -> Option<Instant> {
        self.ended
    }

    /// Keeps the actions of the step that is to follow, if one can.
    pub(super) fn offer(&mut self, actions: Bytes) {
        if self.is_under_way && self.stepped.is_none() {
            self.actions = Some(actions);
        }
    }
}
