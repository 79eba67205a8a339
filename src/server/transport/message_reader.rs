//! Reads gRPC's frames. The length of each message is checked against its stream's present limit before any of its
//! bytes are stored.
//!
//! tonic has one limit for all messages of a service, and decodes them on the transport's thread. So
//! [`raw_body`](super::raw_body) withholds the request bodies of both protocols' streams from tonic, and they are read
//! here.

use super::{
    Error,
    budget::{Budget, MemoryReservation, PendingReservations},
    compression::Compression,
};
use crate::server::{auth::Bearer, limits::RequestLimits, net::managed_io::Connection};
use bytes::{Buf, Bytes, BytesMut};
use http_body::Body as _;
use http_body_util::BodyExt;
use std::time::Duration;
use tokio::{
    task::yield_now,
    time::{Instant, timeout_at},
};
use tonic::{Code, Status, body::Body};

/// The length of a message's header: a flag and a length.
const HEADER_BYTES: usize = 5;
/// The number of a message's first bytes that do not count against the memory budget, so that every stream may send a
/// small message.
const UNBUDGETED_BYTES: usize = 64 << 10;
/// The minimum average rate of a message, bytes per second. A message may take [`StreamLimits::limit`] longer than at
/// this rate.
const MIN_BYTES_PER_SECOND: usize = 64 << 10;
/// A message of at least this length gets an allocation of its own.
const OWN_BUFFER_MIN_BYTES: usize = 1 << 20;

/// The memory budget and the timeouts of a stream.
#[derive(Clone)]
pub struct StreamLimits {
    /// The memory budget of the stream.
    pub budget: Budget,
    /// The time that a client may leave a message unfinished, or a reply unread.
    pub limit: Option<Duration>,
    /// The time that a client may leave the first reply unread.
    pub handshake: Duration,
}

/// Reads the messages of a request's body.
pub struct MessageReader {
    body: Body,
    /// The compression of messages that say that they are compressed.
    compression: Option<Compression>,
    /// The bytes that have arrived and were not returned yet.
    buffer: BytesMut,
    message: Option<PartialMessage>,
    /// The deadline of the partly read message.
    due: Option<Instant>,
    /// The reservation of the partly read message.
    share: MemoryReservation,
    transit: StreamLimits,
    /// The connection of the stream.
    pub connection: Option<Connection>,
    /// The token of the call.
    pub bearer: Option<Bearer>,
    /// The reservations of the stream's replies.
    pub outbox: PendingReservations,
}

/// A partly read message.
enum PartialMessage {
    /// The length of the message.
    Wanted(usize),
    /// The length of the compressed message, and its compression.
    Compressed(usize, Compression),
    /// The budget has no room for the message. Has the number of its bytes that are yet to arrive and to be discarded.
    Refused(usize, Error),
}

/// A message.
pub enum Message {
    /// The bytes of the message, with their reservation.
    Whole(Bytes, MemoryReservation),
    /// The budget has no room for the message, which was discarded.
    Refused(Error),
}

/// Why a stream ends before its client has closed it.
pub enum StreamStop<E = Error> {
    /// The server refuses further requests, with this error.
    Refused(E),
    /// The bytes cannot be decoded, the connection broke, or the server has a defect.
    Broken(Status),
    /// The client or a proxy has reset the stream, or its connection has gone silent.
    Cancelled,
}

impl<E> StreamStop<E> {
    /// Converts the error.
    pub fn map<F>(self, error: impl FnOnce(E) -> F) -> StreamStop<F> {
        match self {
            Self::Refused(refused) => StreamStop::Refused(error(refused)),
            Self::Broken(status) => StreamStop::Broken(status),
            Self::Cancelled => StreamStop::Cancelled,
        }
    }
}

impl<E> From<Status> for StreamStop<E> {
    fn from(status: Status) -> Self {
        Self::Broken(status)
    }
}

impl MessageReader {
    /// The messages of this body.
    pub(super) fn new(
        body: Body,
        compression: Option<Compression>,
        transit: StreamLimits,
        connection: Option<Connection>,
        bearer: Option<Bearer>,
        outbox: PendingReservations,
    ) -> Self {
        Self {
            body,
            compression,
            buffer: BytesMut::new(),
            message: None,
            due: None,
            share: transit.budget.empty(),
            transit,
            connection,
            bearer,
            outbox,
        }
    }

    /// The memory budget of the stream.
    pub fn budget(&self) -> &Budget {
        &self.transit.budget
    }

    /// Moves the reader out and leaves an exhausted one behind.
    pub fn detach(&mut self) -> Self {
        let (connection, bearer) = (self.connection.clone(), self.bearer.clone());
        let outbox = PendingReservations::default();
        let left = Self::new(Body::empty(), None, self.transit.clone(), connection, bearer, outbox);
        std::mem::replace(self, left)
    }

    /// Returns the next message, or `None` after the client has closed the stream. If the future is dropped, no data is
    /// lost: the next call continues.
    ///
    /// # Errors
    /// If the stream must end: the message is too long or stays incomplete, or the bytes are not gRPC.
    pub async fn next(&mut self, limits: RequestLimits) -> Result<Option<Message>, StreamStop> {
        loop {
            if self.message.is_none() && self.buffer.len() >= HEADER_BYTES {
                self.message = Some(self.begin(limits)?);
            }
            if let Some(whole) = self.complete() {
                return Ok(Some(whole));
            }
            if let Some(decompressed) = self.decompress(limits).await? {
                return Ok(Some(decompressed));
            }
            match self.frame().await? {
                Some(Ok(frame)) => {
                    if let Ok(data) = frame.into_data() {
                        self.push_data(&data, limits);
                    }
                }
                Some(Err(status)) if status.code() == Code::Cancelled => return Err(StreamStop::Cancelled),
                // The body of a connection that was silent for too long ends without an error before the stream's end.
                None if !self.body.is_end_stream() => return Err(StreamStop::Cancelled),
                Some(Err(status)) => return Err(status.into()),
                None if self.buffer.is_empty() && self.message.is_none() => return Ok(None),
                None => return Err(Status::internal("the stream ended within a message").into()),
            }
        }
    }

    /// The next HTTP/2 frame. Within a message it must come in time, and the message must keep its minimum rate.
    async fn frame(&mut self) -> Result<Option<Result<http_body::Frame<Bytes>, Status>>, StreamStop> {
        let next = self.body.frame();
        match self.transit.limit.filter(|_| self.message.is_some()) {
            None => Ok(next.await),
            Some(limit) => {
                let soon = Instant::now() + limit;
                let unfinished =
                    |_| StreamStop::Refused(Error::Unfinished { seconds: limit.as_secs(), rate: MIN_BYTES_PER_SECOND });
                timeout_at(self.due.map_or(soon, |due| due.min(soon)), next).await.map_err(unfinished)
            }
        }
    }

    /// Reads a frame's header.
    fn begin(&mut self, limits: RequestLimits) -> Result<PartialMessage, StreamStop> {
        let compression = match self.buffer.get_u8() {
            0 => None,
            1 => Some(self.compression.ok_or_else(|| {
                Status::internal(
                    "a message came compressed, but its call has no header grpc-encoding with gzip or deflate",
                )
            })?),
            flag => return Err(Status::internal(format!("a frame began with {flag}; expected 0: is it gRPC?")).into()),
        };
        let length = self.buffer.get_u32() as usize;
        if length > limits.bytes {
            return Err(StreamStop::Refused(Error::TooLarge { got: length, limit: limits.bytes }));
        }
        let longest = |limit| limit + Duration::from_secs((length / MIN_BYTES_PER_SECOND) as u64);
        self.due = self.transit.limit.map(|limit| Instant::now() + longest(limit));
        Ok(compression
            .map_or(PartialMessage::Wanted(length), |compression| PartialMessage::Compressed(length, compression)))
    }

    /// Returns the partly read message, if it is complete.
    fn complete(&mut self) -> Option<Message> {
        match &mut self.message {
            Some(PartialMessage::Wanted(length)) if self.buffer.len() >= *length => {
                let bytes = if *length < OWN_BUFFER_MIN_BYTES {
                    self.buffer.split_to(*length).freeze()
                } else {
                    // The message takes the whole buffer with it. A slice of the buffer would keep all of its memory.
                    let rest = BytesMut::from(&self.buffer[*length..]);
                    let mut whole = std::mem::replace(&mut self.buffer, rest);
                    whole.truncate(*length);
                    whole.freeze()
                };
                self.message = None;
                Some(Message::Whole(bytes, std::mem::replace(&mut self.share, self.transit.budget.empty())))
            }
            Some(PartialMessage::Refused(left, refusal)) => {
                let come = (*left).min(self.buffer.len());
                self.buffer.advance(come);
                *left -= come;
                let refused = (*left == 0).then(|| Message::Refused(refusal.clone()))?;
                self.message = None;
                Some(refused)
            }
            _ => None,
        }
    }

    /// Decompresses the partly read message, if it is compressed and complete. Dropping the future loses nothing.
    async fn decompress(&mut self, limits: RequestLimits) -> Result<Option<Message>, StreamStop> {
        let Some(PartialMessage::Compressed(length, compression)) = self.message else { return Ok(None) };
        let Some(compressed) = self.buffer.get(..length) else { return Ok(None) };
        let mut decompressor = compression.decompressor(compressed);
        let mut share = self.transit.budget.empty();
        let mut bytes = Vec::new();
        let message = loop {
            let more = decompressor.append_part(&mut bytes);
            let more = more.map_err(|error| Status::internal(format!("a message is not {compression}: {error}")))?;
            if bytes.len() > limits.bytes {
                return Err(StreamStop::Refused(Error::DecompressedTooLarge { limit: limits.bytes }));
            }
            let budgeted = bytes.len().saturating_sub(unbudgeted(limits));
            if let Err(refusal) = share.grow(budgeted - share.bytes()) {
                break Message::Refused(refusal);
            }
            if !more {
                break Message::Whole(bytes.into(), share);
            }
            yield_now().await;
        };
        drop(decompressor);
        if length < OWN_BUFFER_MIN_BYTES {
            self.buffer.advance(length);
        } else {
            self.buffer = BytesMut::from(&self.buffer[length..]); // the memory of the message goes with it
        }
        self.share = self.transit.budget.empty();
        self.message = None;
        Ok(Some(message))
    }

    /// Appends bytes that have arrived, and reserves memory for them.
    fn push_data(&mut self, data: &[u8], limits: RequestLimits) {
        if let Some(PartialMessage::Wanted(length) | PartialMessage::Compressed(length, _)) = self.message {
            let beyond = |bytes: usize| bytes.min(length).saturating_sub(unbudgeted(limits));
            let (before, after) = (beyond(self.buffer.len()), beyond(self.buffer.len() + data.len()));
            if let Err(refusal) = self.share.grow(after - before) {
                self.share = self.transit.budget.empty();
                // The bytes that have arrived are dropped with their reservation.
                let come = std::mem::take(&mut self.buffer).len();
                self.message = Some(PartialMessage::Refused(length - come, refusal));
            }
            if self.buffer.capacity() - self.buffer.len() < data.len() {
                // The buffer doubles, whatever length is announced: a client may announce more than it sends.
                let rest = length.saturating_sub(self.buffer.len());
                self.buffer.reserve(rest.min(self.buffer.len()).max(data.len()));
            }
        }
        self.buffer.extend_from_slice(data);
    }
}

/// Returns the bytes of a message that need no reservation.
fn unbudgeted(limits: RequestLimits) -> usize {
    limits.covered.max(UNBUDGETED_BYTES)
}
