//! The result of a step, gathered from the shards.

use super::{
    encode::{push_f32, push_wide},
    receipts::ReceiptColumns,
    shard::Shard,
    sync::lock,
};
use crate::env::{EpisodeEnd, EpisodeStart};
use bytes::{Bytes, BytesMut};
use std::sync::Mutex;

/// The outcome of a step; arrays are little-endian, as on the wire.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StepResult {
    /// f32 `[N, O]`
    pub observations: Bytes,
    /// f32 `[N]`
    pub rewards: Bytes,
    /// u8 `[N]`
    pub terminated: Bytes,
    /// u8 `[N]`
    pub truncated: Bytes,
    /// f32 `[N, terms]`, or empty
    pub reward_terms: Bytes,
    /// f32 `[K, O]`
    pub final_observations: Bytes,
    /// `[K]`: slot and episode.
    pub ended: Vec<(u32, EpisodeEnd)>,
    /// Slot and episode; only with receipts.
    pub started: Vec<(u32, EpisodeStart)>,
    /// u64 `[M, 5]`, only with receipts as arrays: slot, indices of environment, trial and episode, number in the
    /// trial. The rows of the episodes that ended come before those of the episodes that began.
    pub receipt_episodes: Bytes,
    /// f64 `[M, P + Q]`: requested and applied values.
    pub receipt_values: Bytes,
}

/// The shards whose outputs are gathered, and the buffer from which the gathered arrays are split off.
pub(super) struct ShardOutputs<'a> {
    pub(super) shards: &'a [Mutex<Shard>],
    pub(super) buffer: &'a mut BytesMut,
}

impl ShardOutputs<'_> {
    /// Gathers the outputs of the last step from the shards. The reward's terms are left out unless `reward_terms`.
    pub(super) fn step_result(mut self, reward_terms: bool) -> StepResult {
        StepResult {
            observations: self.observations(),
            rewards: self.f32(|shard| &shard.rewards),
            terminated: self.u8(|shard| &shard.terminated),
            truncated: self.u8(|shard| &shard.truncated),
            reward_terms: if reward_terms { self.f32(|shard| &shard.reward_terms) } else { Bytes::new() },
            final_observations: self.f32(|shard| &shard.final_observations),
            ended: collect(self.shards, |shard| &mut shard.ended),
            started: collect(self.shards, |shard| &mut shard.started),
            receipt_episodes: self.receipts(|receipts| &receipts.episodes, u64::to_le_bytes),
            receipt_values: self.receipts(|receipts| &receipts.values, f64::to_le_bytes),
        }
    }

    /// Gathers the present observations of all environments, f32 `[N, O]`.
    pub(super) fn observations(&mut self) -> Bytes {
        self.f32(|shard| &shard.observations)
    }

    fn f32(&mut self, field: impl Fn(&Shard) -> &Vec<f32>) -> Bytes {
        for shard in self.shards {
            push_f32(self.buffer, field(&lock(shard)));
        }
        self.buffer.split().freeze()
    }

    /// Gathers receipts of the episodes that ended in all shards, then of those that began.
    fn receipts<T: Copy>(&mut self, column: fn(&ReceiptColumns) -> &Vec<T>, encode: fn(T) -> [u8; 8]) -> Bytes {
        let parts: [fn(&Shard) -> &ReceiptColumns; 2] =
            [|shard| &shard.ended_receipts, |shard| &shard.started_receipts];
        for receipts in parts {
            for shard in self.shards {
                push_wide(self.buffer, column(receipts(&lock(shard))), encode);
            }
        }
        self.buffer.split().freeze()
    }

    fn u8(&mut self, field: impl Fn(&Shard) -> &Vec<u8>) -> Bytes {
        for shard in self.shards {
            self.buffer.extend_from_slice(field(&lock(shard)));
        }
        self.buffer.split().freeze()
    }
}

/// Gathers the lists of all shards into one.
pub(super) fn collect<T>(shards: &[Mutex<Shard>], field: impl Fn(&mut Shard) -> &mut Vec<T>) -> Vec<T> {
    let mut all = Vec::new();
    for shard in shards {
        all.append(field(&mut lock(shard)));
    }
    all
}
