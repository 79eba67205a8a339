//! Numbers as they are on the wire: little-endian, without gaps.

use super::{shard::Shard, workers::lock};
use bytes::BytesMut;
use std::sync::Mutex;

/// Appends f32.
pub(super) fn put(buffer: &mut BytesMut, values: &[f32]) {
    let start = buffer.len();
    buffer.resize(start + 4 * values.len(), 0);
    let words = buffer[start..].as_chunks_mut::<4>().0;
    words.iter_mut().zip(values).for_each(|(to, from)| *to = from.to_le_bytes());
}

/// Appends numbers of 64 bits.
pub(super) fn put_wide<T: Copy>(buffer: &mut BytesMut, values: &[T], encode: impl Fn(T) -> [u8; 8]) {
    let start = buffer.len();
    buffer.resize(start + 8 * values.len(), 0);
    let words = buffer[start..].as_chunks_mut::<8>().0;
    words.iter_mut().zip(values).for_each(|(to, from)| *to = encode(*from));
}

/// Appends u8, 0 or 1.
pub(super) fn put_flags(buffer: &mut BytesMut, flags: &[bool]) {
    let start = buffer.len();
    buffer.resize(start + flags.len(), 0);
    buffer[start..].iter_mut().zip(flags).for_each(|(to, from)| *to = (*from).into());
}

/// Gives every shard its part of a batch's actions, i32 `[N]` or f32 `[N, A]`.
pub(super) fn put_actions(shards: &[Mutex<Shard>], actions: &[u8]) {
    let mut words = actions.as_chunks::<4>().0.iter();
    for shard in shards {
        let mut shard = lock(shard);
        let Shard { choices, vectors, .. } = &mut *shard;
        // One of the two is empty. The words come second in each pair, so that none is lost where a shard's part ends.
        choices.iter_mut().zip(&mut words).for_each(|(to, from)| *to = u32::from_le_bytes(*from));
        vectors.iter_mut().zip(&mut words).for_each(|(to, from)| *to = f32::from_le_bytes(*from));
    }
}
