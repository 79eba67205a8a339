//! Reads the length-prefixed messages of a gRPC stream. As soon as a message's header has arrived, the message's length
//! is checked against the limit that applies to its stream at this moment.
//!
//! tonic has only one limit for all messages of a service, and decodes them on the transport thread. Therefore
//! [`raw_body`](super::raw_body) withholds the request bodies of sessions from tonic, and this module reads them.

use super::{
    Error,
    budget::{Budget, MemoryReservation, PendingReservations},
    compression::Compression,
};
use crate::server::{auth::Bearer, limits::RequestLimits, net::managed_io::ConnectionHandle};
use bytes::{Buf, Bytes, BytesMut};
use http_body::Body as _;
use http_body_util::BodyExt;
use std::time::Duration;
use tokio::{
    task::yield_now,
    time::{Instant, timeout_at},
};
use tonic::{Code, Status, body::Body};

/// The length of the header of a gRPC message: a flag of one byte and a length of four bytes.
const HEADER_BYTES: usize = 5;
/// The number of bytes at the start of each message that do not count against the memory budget, so every stream may
/// send a small message.
const UNBUDGETED_BYTES: usize = 64 << 10;
/// The minimum average rate at which a message must arrive, bytes per second. A message may take
/// [`StreamLimits::limit`] longer than it would take at this rate.
const MIN_BYTES_PER_SECOND: usize = 64 << 10;
/// A message of at least this length, in bytes, gets an allocation of its own.
const OWN_BUFFER_MIN_BYTES: usize = 1 << 20;

/// The memory budget and the timeouts of a stream.
#[derive(Clone)]
pub struct StreamLimits {
    /// The memory budget of the stream.
    pub budget: Budget,
    /// The maximum pause within an incomplete message, and the maximum time that a client may leave a reply unread;
    /// `None` for no limit.
    pub limit: Option<Duration>,
    /// The maximum time that a client may leave the first reply unread.
    pub handshake: Duration,
}

/// A reader of a stream's gRPC messages, from the body of its HTTP request.
pub struct MessageReader {
    body: Body,
    /// The compression of those messages whose header says that they are compressed.
    compression: Option<Compression>,
    /// The bytes that have arrived and are not yet part of a returned message.
    buffer: BytesMut,
    message: Option<PartialMessage>,
    /// The deadline for the end of the partly read message.
    deadline: Option<Instant>,
    /// The memory reservation of the partly read message.
    reservation: MemoryReservation,
    stream_limits: StreamLimits,
    /// The connection of the stream, if it is known.
    pub connection: Option<ConnectionHandle>,
    /// The token of the call; `None` if the server requires none.
    pub bearer: Option<Bearer>,
    /// The queue for memory reservations of the stream's replies.
    pub pending_reservations: PendingReservations,
}

/// The state of a message whose header has been read.
enum PartialMessage {
    /// An uncompressed message of this length, bytes.
    Wanted(usize),
    /// A compressed message: its compressed length in bytes, and its compression.
    Compressed(usize, Compression),
    /// A message for which the memory budget has no room: the number of its bytes that are still to arrive and to be
    /// discarded, and the error.
    Refused(usize, Error),
}

/// A message that has arrived completely.
pub enum Message {
    /// The bytes of the message, with their memory reservation.
    Whole(Bytes, MemoryReservation),
    /// The message was discarded, because the memory budget had no room for it.
    Refused(Error),
}

/// Why the server stops reading a stream that its client has not closed.
pub enum StreamStop<E = Error> {
    /// The server ends the stream with this error.
    Refused(E),
    /// The bytes cannot be decoded, the connection failed, or the server has a defect.
    Broken(Status),
    /// The client or a proxy has cancelled the stream, or its connection did not answer keepalives.
    Cancelled,
}

impl<E> StreamStop<E> {
    /// Converts the error of [`StreamStop::Refused`], and leaves other variants unchanged.
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
    /// Makes a reader of the messages of `body`.
    pub(super) fn new(
        body: Body,
        compression: Option<Compression>,
        stream_limits: StreamLimits,
        connection: Option<ConnectionHandle>,
        bearer: Option<Bearer>,
        pending_reservations: PendingReservations,
    ) -> Self {
        Self {
            body,
            compression,
            buffer: BytesMut::new(),
            message: None,
            deadline: None,
            reservation: stream_limits.budget.empty(),
            stream_limits,
            connection,
            bearer,
            pending_reservations,
        }
    }

    /// The memory budget of the stream.
    pub fn budget(&self) -> &Budget {
        &self.stream_limits.budget
    }

    /// Moves the reader out and leaves a reader without messages in its place.
    pub fn detach(&mut self) -> Self {
        let (connection, bearer) = (self.connection.clone(), self.bearer.clone());
        let pending_reservations = PendingReservations::default();
        let left = Self::new(Body::empty(), None, self.stream_limits.clone(), connection, bearer, pending_reservations);
        std::mem::replace(self, left)
    }

    /// Returns the next message, or `None` after the client has closed the stream. Cancel safe: if the future is
    /// dropped, the next call continues reading.
    ///
    /// # Errors
    /// If the stream must end: the message is too long, incomplete or malformed, the client has cancelled the stream,
    /// or the connection is lost.
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
                // If the client did not answer keepalives, the connection was closed. Then the body ends without an
                // error, but the stream has not ended.
                None if !self.body.is_end_stream() => return Err(StreamStop::Cancelled),
                Some(Err(status)) => return Err(status.into()),
                None if self.buffer.is_empty() && self.message.is_none() => return Ok(None),
                None => return Err(Status::internal("the stream ended within a message").into()),
            }
        }
    }

    /// Returns the next HTTP/2 frame. Within a message, enforces the maximum pause and the message's deadline.
    async fn frame(&mut self) -> Result<Option<Result<http_body::Frame<Bytes>, Status>>, StreamStop> {
        let next = self.body.frame();
        match self.stream_limits.limit.filter(|_| self.message.is_some()) {
            None => Ok(next.await),
            Some(limit) => {
                let pause_end = Instant::now() + limit;
                let unfinished =
                    |_| StreamStop::Refused(Error::Unfinished { seconds: limit.as_secs(), rate: MIN_BYTES_PER_SECOND });
                timeout_at(self.deadline.map_or(pause_end, |deadline| deadline.min(pause_end)), next)
                    .await
                    .map_err(unfinished)
            }
        }
    }

    /// Reads the header of a message, checks its length, and sets its deadline.
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
        let max_duration = |limit| limit + Duration::from_secs((length / MIN_BYTES_PER_SECOND) as u64);
        self.deadline = self.stream_limits.limit.map(|limit| Instant::now() + max_duration(limit));
        Ok(compression
            .map_or(PartialMessage::Wanted(length), |compression| PartialMessage::Compressed(length, compression)))
    }

    /// Returns the partly read message if all of its bytes have arrived. A compressed message is left to `decompress`.
    fn complete(&mut self) -> Option<Message> {
        match &mut self.message {
            Some(PartialMessage::Wanted(length)) if self.buffer.len() >= *length => {
                let bytes = if *length < OWN_BUFFER_MIN_BYTES {
                    self.buffer.split_to(*length).freeze()
                } else {
                    // Gives the message the buffer's allocation, and copies the bytes after the message to a new
                    // buffer. If both shared the allocation, the reader would keep the message's memory alive after the
                    // message is dropped.
                    let rest = BytesMut::from(&self.buffer[*length..]);
                    let mut whole = std::mem::replace(&mut self.buffer, rest);
                    whole.truncate(*length);
                    whole.freeze()
                };
                self.message = None;
                Some(Message::Whole(bytes, std::mem::replace(&mut self.reservation, self.stream_limits.budget.empty())))
            }
            Some(PartialMessage::Refused(left, refusal)) => {
                let arrived = (*left).min(self.buffer.len());
                self.buffer.advance(arrived);
                *left -= arrived;
                let refused = (*left == 0).then(|| Message::Refused(refusal.clone()))?;
                self.message = None;
                Some(refused)
            }
            _ => None,
        }
    }

    /// Returns the partly read message, decompressed, if it is compressed and all of its bytes have arrived. Cancel
    /// safe.
    async fn decompress(&mut self, limits: RequestLimits) -> Result<Option<Message>, StreamStop> {
        let Some(PartialMessage::Compressed(length, compression)) = self.message else { return Ok(None) };
        let Some(compressed) = self.buffer.get(..length) else { return Ok(None) };
        let mut decompressor = compression.decompressor(compressed);
        let mut reservation = self.stream_limits.budget.empty();
        let mut bytes = Vec::new();
        let message = loop {
            let more = decompressor.append_part(&mut bytes);
            let more = more.map_err(|error| Status::internal(format!("a message is not {compression}: {error}")))?;
            if bytes.len() > limits.bytes {
                return Err(StreamStop::Refused(Error::DecompressedTooLarge { limit: limits.bytes }));
            }
            let budgeted = bytes.len().saturating_sub(unbudgeted(limits));
            if let Err(refusal) = reservation.grow(budgeted - reservation.bytes()) {
                break Message::Refused(refusal);
            }
            if !more {
                break Message::Whole(bytes.into(), reservation);
            }
            yield_now().await;
        };
        drop(decompressor);
        if length < OWN_BUFFER_MIN_BYTES {
            self.buffer.advance(length);
        } else {
            self.buffer = BytesMut::from(&self.buffer[length..]); // frees the memory of the message
        }
        self.reservation = self.stream_limits.budget.empty();
        self.message = None;
        Ok(Some(message))
    }

    /// Stores bytes that have arrived, and reserves memory for them.
    fn push_data(&mut self, data: &[u8], limits: RequestLimits) {
        if let Some(PartialMessage::Wanted(length) | PartialMessage::Compressed(length, _)) = self.message {
            let budgeted_bytes = |bytes: usize| bytes.min(length).saturating_sub(unbudgeted(limits));
            let (before, after) = (budgeted_bytes(self.buffer.len()), budgeted_bytes(self.buffer.len() + data.len()));
            if let Err(refusal) = self.reservation.grow(after - before) {
                self.reservation = self.stream_limits.budget.empty();
                // Frees the bytes of the message that have already arrived. The line above released their reservation.
                let arrived = std::mem::take(&mut self.buffer).len();
                self.message = Some(PartialMessage::Refused(length - arrived, refusal));
            }
            if self.buffer.capacity() - self.buffer.len() < data.len() {
                // The buffer at most doubles, because a client may announce a longer message than it sends.
                let rest = length.saturating_sub(self.buffer.len());
                self.buffer.reserve(rest.min(self.buffer.len()).max(data.len()));
            }
        }
        self.buffer.extend_from_slice(data);
    }
}

/// Returns how many bytes of a message need no reservation.
fn unbudgeted(limits: RequestLimits) -> usize {
    limits.covered.max(UNBUDGETED_BYTES)
}
