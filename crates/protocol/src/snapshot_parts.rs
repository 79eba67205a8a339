//! Snapshots of a large batch, cut into several requests and replies.

use std::ops::Range;

/// The maximum length of the snapshots in one request or reply, in bytes. It is below 4 MiB, the limit of many servers
/// and libraries, and leaves room for distributions that grew since `open`.
const MAX_PART_BYTES: usize = 2 << 20;

/// Cuts snapshots of these lengths, in bytes, into ranges in order. Each range fits in one message. There is at least one
/// range, which is empty if there are no snapshots. A snapshot that is longer than a message has a range of its own.
pub fn snapshot_parts(lengths: impl IntoIterator<Item = usize>) -> Vec<Range<usize>> {
    parts(lengths, MAX_PART_BYTES)
}

fn parts(lengths: impl IntoIterator<Item = usize>, limit: usize) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let mut part = 0..0;
    let mut bytes = 0_usize;
    for (i, length) in lengths.into_iter().enumerate() {
        if bytes.saturating_add(length) > limit && !part.is_empty() {
            parts.push(part);
            part = i..i;
            bytes = 0;
        }
        part.end = i + 1;
        bytes = bytes.saturating_add(length);
    }
    parts.push(part);
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the only part of snapshots that fit in one message.
    fn one(part: Range<usize>) -> Vec<Range<usize>> {
        vec![part]
    }

    #[test]
    fn parts_fit_in_a_message_and_keep_the_order() {
        assert_eq!(parts([], 10), one(0..0));
        assert_eq!(parts([4, 4, 2, 1], 10), [0..3, 3..4]);
        assert_eq!(parts([0; 1000], 10), one(0..1000), "servers that tell no length");
        assert_eq!(parts([5; 7], 10), [0..2, 2..4, 4..6, 6..7]);
        assert_eq!(parts([1, 11, usize::MAX, usize::MAX, 10], 10), [0..1, 1..2, 2..3, 3..4, 4..5], "too long ones");
    }

    #[test]
    fn snapshots_of_a_thousand_robots_are_one_part() {
        assert_eq!(snapshot_parts([600; 1024]), one(0..1024));
        assert_eq!(snapshot_parts([384 << 10; 11]).len(), 3);
    }
}
