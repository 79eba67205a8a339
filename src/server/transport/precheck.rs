//! Decodes requests. An entry of a repeated field may take two encoded bytes but a hundred bytes in memory, so the
//! number of entries is checked before a request is decoded. Requests with many fields are decoded outside the
//! transport threads.

use self::FieldKind::{Fields, Numbers};
use crate::{
    priority::lower,
    server::{error::InvalidValue, limits::RequestLimits},
};
use bytes::Bytes;
use prost::Message;
use std::sync::Arc;
use tokio::sync::Semaphore;
use tonic::Status;

/// A request with at most this many fields is decoded on the transport thread, because passing it to another thread
/// would take longer.
const INLINE_DECODE_MAX_FIELDS: usize = 1000;
/// The maximum number of requests that are decoded at the same time outside the transport threads.
const MAX_CONCURRENT_DECODES: usize = 2;
/// The niceness of threads that decode requests, so that transport and physics take precedence.
const DECODER_NICENESS: i32 = 5;
/// The maximum number of entries of repeated fields whose length does not depend on the batch size. The limit is loose
/// on purpose: later validation enforces tighter limits with better messages.
pub const MAX_REPEATED: usize = 1024;
/// The number of bytes of a packed field that take as long to count as one unpacked field.
const PACKED_BYTES_PER_FIELD: usize = 64;
/// The maximum number of [`Field`]s that a message type may have.
const MAX_COUNTED_FIELDS: usize = 8;

/// A field of a message type. The number of the field's entries is checked before a message is decoded.
pub struct Field {
    number: u64,
    name: &'static str,
    max_entries: Cardinality,
    kind: FieldKind,
}

/// The type of a field's entries.
pub enum FieldKind {
    /// Nested messages, with the list of their fields whose entries are also counted.
    Fields(&'static [Field]),
    /// Numbers, packed or unpacked.
    Numbers,
    /// Any other type, whose content is not examined.
    Opaque,
}

/// The maximum number of entries of a field.
pub enum Cardinality {
    /// At most one.
    One,
    /// At most [`MAX_REPEATED`].
    Many,
    /// At most the batch size, or [`MAX_REPEATED`] if that is larger.
    Environments,
}

impl Cardinality {
    fn entries(&self, limits: RequestLimits) -> usize {
        match self {
            Self::One => 1,
            Self::Many => MAX_REPEATED,
            Self::Environments => limits.entries.max(MAX_REPEATED),
        }
    }
}

/// Makes a [`Field`] from its field number, its name in errors, the maximum number of its entries, and their type.
pub const fn field(number: u64, name: &'static str, max_entries: Cardinality, kind: FieldKind) -> Field {
    Field { number, name, max_entries, kind }
}

/// A decoder of requests. It decodes large requests outside the transport threads.
#[derive(Clone)]
pub struct Decoder(Arc<Semaphore>);

impl Default for Decoder {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(MAX_CONCURRENT_DECODES)))
    }
}

/// Decodes a request on the calling thread. Returns `None` if the request is malformed, has too many entries, or has so
/// many fields that it must be decoded on another thread.
pub fn decoded_at_once<T: Message + Default>(
    bytes: Bytes,
    fields: &'static [Field],
    limits: RequestLimits,
) -> Option<T> {
    check(&bytes, fields, limits, INLINE_DECODE_MAX_FIELDS).ok()?;
    decoded(bytes).ok()
}

impl Decoder {
    /// Decodes a request. The inner error is the reason for refusing it, e.g. too many entries.
    ///
    /// # Errors
    /// A status that ends the stream, if the bytes are not a valid message.
    pub async fn decode<T: Message + Default + 'static>(
        &self,
        bytes: Bytes,
        fields: &'static [Field],
        limits: RequestLimits,
    ) -> Result<Result<T, InvalidValue>, Status> {
        match check(&bytes, fields, limits, INLINE_DECODE_MAX_FIELDS) {
            Ok(()) => return decoded(bytes).map(Ok),
            Err(PrecheckError::Refused(refusal)) => return Ok(Err(refusal)),
            Err(PrecheckError::Work) => {}
        }
        let defect = || Status::internal("a request could not be decoded: a defect of the server");
        let _turn = self.0.acquire().await.map_err(|_| defect())?;
        let decoding = tokio::task::spawn_blocking(move || {
            lower(DECODER_NICENESS);
            match check(&bytes, fields, limits, usize::MAX) {
                Err(PrecheckError::Refused(refusal)) => Ok(Err(refusal)),
                _ => decoded(bytes).map(Ok),
            }
        });
        decoding.await.map_err(|_| defect())?
    }
}

fn decoded<T: Message + Default>(bytes: Bytes) -> Result<T, Status> {
    T::decode(bytes).map_err(|error| Status::internal(error.to_string()))
}

/// Why a count of a message's fields stopped early.
#[derive(Debug, PartialEq)]
enum PrecheckError {
    /// The message has more fields than the caller allows to be counted.
    Work,
    Refused(InvalidValue),
}

/// Checks the numbers of entries in a message. Stops after about `work` fields. Malformed bytes end the check without
/// an error, since the decoder then refuses them.
fn check(message: &[u8], fields: &[Field], limits: RequestLimits, mut work: usize) -> Result<(), PrecheckError> {
    count(message, fields, limits, &mut work).map(|_| ())
}

/// Checks the numbers of entries in a message or nested message. Returns whether it is well-formed.
fn count(mut message: &[u8], fields: &[Field], limits: RequestLimits, work: &mut usize) -> Result<bool, PrecheckError> {
    let mut counts = [0; MAX_COUNTED_FIELDS];
    while !message.is_empty() {
        *work = work.checked_sub(1).ok_or(PrecheckError::Work)?;
        let Some(tag) = varint(&mut message) else { return Ok(false) };
        let part = match tag & 7 {
            0 => varint(&mut message).map(|_| &[][..]),
            1 => message.split_off(..8),
            2 => varint(&mut message).and_then(|length| message.split_off(..usize::try_from(length).ok()?)),
            5 => message.split_off(..4),
            // Wire types 3 and 4 are groups, which proto3 does not have. Types 6 and 7 do not exist.
            kind => {
                let got = format!("with a field of wire type {kind}");
                return Err(PrecheckError::Refused(InvalidValue::new("request", got, "wire types 0, 1, 2 and 5")));
            }
        };
        let Some(part) = part else { return Ok(false) };
        let Some((field, counted)) = fields.iter().zip(&mut counts).find(|(field, _)| field.number == tag >> 3) else {
            continue;
        };
        *counted += match field.kind {
            Numbers if tag & 7 == 2 => {
                *work = work.checked_sub(part.len() / PACKED_BYTES_PER_FIELD).ok_or(PrecheckError::Work)?;
                part.iter().filter(|byte| **byte < 0x80).count() // counts the last byte of each number
            }
            _ => 1,
        };
        let max_entries = field.max_entries.entries(limits);
        if *counted > max_entries {
            let got = format!("present more than {max_entries} times");
            return Err(PrecheckError::Refused(InvalidValue::new(field.name, got, format!("at most {max_entries}"))));
        }
        if let Fields(fields) = field.kind
            && !count(part, fields, limits, work)?
        {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Reads a number in protobuf's variable-length encoding from the front of `message`.
fn varint(message: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let (&byte, rest) = message.split_first()?;
        *message = rest;
        value |= u64::from(byte & 0x7F) << shift;
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        proto::{self, session_request::Request},
        server::api::perturb_v1::fields::SESSION_REQUEST,
    };

    const LIMITS: RequestLimits = RequestLimits { bytes: 0, entries: 2000, covered: 0 };

    fn checked(request: impl Into<Request>, work: usize) -> Result<(), PrecheckError> {
        let message = proto::SessionRequest { request: Some(request.into()) }.encode_to_vec();
        check(&message, SESSION_REQUEST, LIMITS, work)
    }

    fn refused(request: impl Into<Request>) -> String {
        match checked(request, usize::MAX) {
            Err(PrecheckError::Refused(refusal)) => refusal.to_string(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn entries_are_counted_packed_or_unpacked() {
        let reset = |seeds| proto::Reset { seeds, ..proto::Reset::default() };
        assert_eq!(checked(reset(vec![u64::MAX; 2000]), usize::MAX), Ok(()));
        assert!(refused(reset(vec![1; 2001])).contains("reset.seeds is present more than 2000 times"));
        let unpacked = [&[0x1A, 0xA2, 0x1F][..], &[0x10, 1].repeat(2001)].concat();
        assert!(matches!(check(&unpacked, SESSION_REQUEST, LIMITS, usize::MAX), Err(PrecheckError::Refused(_))));
        let policy = proto::Policy { hidden: vec![1; 1025], ..proto::Policy::default() };
        assert!(refused(proto::Act { policy: Some(policy), ..proto::Act::default() }).contains("act.policy.hidden"));
        let restore = proto::Restore { snapshots: vec![Bytes::new(); 2001], ..proto::Restore::default() };
        assert!(refused(restore).contains("restore.snapshots"));
    }

    #[test]
    fn entries_within_entries_are_counted() {
        let intervals = vec![proto::Interval::default(); 1025];
        let parameters = [("force".to_owned(), proto::Distribution { intervals })].into();
        let group = proto::SlotGroup { parameters, ..proto::SlotGroup::default() };
        let open = proto::Open { groups: vec![proto::SlotGroup::default(), group], ..proto::Open::default() };
        assert!(refused(open).contains("intervals"));
        assert!(
            refused(proto::Open { groups: vec![Default::default(); 2001], ..Default::default() }).contains("groups")
        );
    }

    #[test]
    fn a_message_may_contain_only_one_request() {
        let twice = [0x12, 0].repeat(2);
        assert!(matches!(check(&twice, SESSION_REQUEST, LIMITS, usize::MAX), Err(PrecheckError::Refused(_))));
    }

    #[test]
    fn many_fields_are_not_counted_inline_but_many_bytes_are() {
        let restore = |n| proto::Restore { snapshots: vec![Bytes::new(); n], ..proto::Restore::default() };
        assert_eq!(checked(restore(INLINE_DECODE_MAX_FIELDS), INLINE_DECODE_MAX_FIELDS), Err(PrecheckError::Work));
        let seeds = proto::Reset { seeds: vec![1; 1 << 20], ..proto::Reset::default() };
        assert_eq!(checked(seeds, INLINE_DECODE_MAX_FIELDS), Err(PrecheckError::Work));
        assert_eq!(checked(proto::Step { actions: vec![0; 1 << 20].into() }, INLINE_DECODE_MAX_FIELDS), Ok(()));
    }

    #[test]
    fn malformed_messages_end_the_count_and_never_panic() {
        let whole = proto::SessionRequest {
            request: Some(Request::Reset(proto::Reset { seeds: vec![300; 3], ..proto::Reset::default() })),
        }
        .encode_to_vec();
        for length in 0..whole.len() {
            assert_eq!(check(&whole[..length], SESSION_REQUEST, LIMITS, usize::MAX), Ok(()));
        }
        for message in [&[0xFF; 30][..], &[0x1A, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x7F], &[0x0D, 1]] {
            let _ = check(message, SESSION_REQUEST, LIMITS, usize::MAX);
        }
    }
}
