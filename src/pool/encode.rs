//! Encodes arrays in the format of messages: little-endian, without gaps.

use bytes::BytesMut;

/// Appends f32 values.
pub(super) fn push_f32(buffer: &mut BytesMut, values: &[f32]) {
    let start = buffer.len();
    buffer.resize(start + 4 * values.len(), 0);
    let words = buffer[start..].as_chunks_mut::<4>().0;
    words.iter_mut().zip(values).for_each(|(to, from)| *to = from.to_le_bytes());
}

/// Appends 64-bit numbers. `encode` converts each number to its 8 bytes.
pub(super) fn push_wide<T: Copy>(buffer: &mut BytesMut, values: &[T], encode: impl Fn(T) -> [u8; 8]) {
    let start = buffer.len();
    buffer.resize(start + 8 * values.len(), 0);
    let words = buffer[start..].as_chunks_mut::<8>().0;
    words.iter_mut().zip(values).for_each(|(to, from)| *to = encode(*from));
}

/// Appends flags as u8, 0 or 1.
pub(super) fn push_flags(buffer: &mut BytesMut, flags: &[bool]) {
    let start = buffer.len();
    buffer.resize(start + flags.len(), 0);
    buffer[start..].iter_mut().zip(flags).for_each(|(to, from)| *to = (*from).into());
}
