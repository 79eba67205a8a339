//! The result of a step, and how it is gathered from the shards.

use super::{
    encode::{push_f32, push_wide},
    receipts::ReceiptColumns,
    shard::Shard,
    sync::lock,
};
use crate::env::{FinishedEpisode, StartedEpisode};
use bytes::{Bytes, BytesMut};
use std::sync::Mutex;

/// The result of a step of N environments, in which K episodes ended. Arrays are little-endian, as in messages.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct StepResult {
    /// The observations after the step, f32 `[N, O]`.
    pub observations: Bytes,
    /// The rewards, f32 `[N]`.
    pub rewards: Bytes,
    /// 1 where the task ended the episode, u8 `[N]`.
    pub terminated: Bytes,
    /// 1 where the step limit ended the episode, u8 `[N]`. Both flags may be 1.
    pub truncated: Bytes,
    /// The terms of the rewards, f32 `[N, terms]`; empty unless requested.
    pub reward_terms: Bytes,
    /// The last observations of the episodes that ended, f32 `[K, O]`.
    pub final_observations: Bytes,
    /// The K episodes that ended, each with its slot, in order of slots.
    pub ended: Vec<(u32, FinishedEpisode)>,
    /// The episodes that autoreset began, each with its slot. Empty unless receipts are sent as messages.
    pub started: Vec<(u32, StartedEpisode)>,
    /// The M episodes whose receipts `receipt_values` has, u64 `[M, 5]`. Empty unless receipts are sent as arrays.
    /// Columns: slot, environment index, trial index, episode index, number within the trial. The K ended episodes come
    /// before the episodes that began.
    pub receipt_episodes: Bytes,
    /// The receipts of the M episodes in `receipt_episodes`, f64 `[M, P + Q]`: P requested values, then Q applied
    /// values.
    pub receipt_values: Bytes,
}

/// Gathers the outputs of a batch's shards into arrays for a reply. Each array is written to `buffer` and then split
/// off from it, so later results can reuse the buffer's memory.
pub(super) struct ShardOutputs<'a> {
    pub(super) shards: &'a [Mutex<Shard>],
    pub(super) buffer: &'a mut BytesMut,
}

impl ShardOutputs<'_> {
    /// Gathers the result of the last step. The result contains the terms of the rewards only if `reward_terms` is
    /// true.
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

    /// Gathers the current observations of all environments, f32 `[N, O]`.
    pub(super) fn observations(&mut self) -> Bytes {
        self.f32(|shard| &shard.observations)
    }

    fn f32(&mut self, field: impl Fn(&Shard) -> &Vec<f32>) -> Bytes {
        for shard in self.shards {
            push_f32(self.buffer, field(&lock(shard)));
        }
        self.buffer.split().freeze()
    }

    /// Gathers one array of the receipts: first the receipts of all ended episodes, then those of all episodes that
    /// began.
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

/// Moves the lists of all shards into one list.
pub(super) fn collect<T>(shards: &[Mutex<Shard>], field: impl Fn(&mut Shard) -> &mut Vec<T>) -> Vec<T> {
    let mut all = Vec::new();
    for shard in shards {
        all.append(field(&mut lock(shard)));
    }
    all
}
