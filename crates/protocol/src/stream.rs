//! A client's side of a session: sends typed requests and receives their typed replies.

mod lease;

use std::collections::VecDeque;
use std::future::poll_fn;
use std::pin::Pin;
use std::task::Poll;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_stream::Stream as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use self::lease::{ClientLease, MAX_RESUMES_WITHOUT_REPLY};

use crate::adaptive_spin::AdaptiveSpin;
use crate::address::Address;
use crate::connection::Connection;
use crate::error::{ClientError, lost, timed_out};
use crate::escape::{escape_environment, escape_lines};
use crate::proto::{self, SessionRequest, SessionResponse, session_request::Request, session_response::Response};

/// Number of requests that the channel to the sending task holds. More requests wait in [`Stream::send`].
const QUEUE_LENGTH: usize = 4;
/// Maximal time that [`Stream::close`] waits for the server to end the session.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// A type of request that a session can send. It determines the type of the reply.
pub trait TypedRequest: Into<Request> {
    /// The type of the reply.
    type Reply;
    /// The request as error messages name it, e.g. "a step".
    const NAME: &'static str;

    /// Extracts the reply to this type of request from a response.
    ///
    /// # Errors
    /// The field name of the response, if it is another type of reply.
    fn reply(response: Response) -> Result<Self::Reply, &'static str>;
}

macro_rules! requests {
    ($($request:ident => $reply:ident, $variant:ident, $answer:ident, $field:literal, $name:literal;)*) => {
        $(
            impl From<proto::$request> for Request {
                fn from(request: proto::$request) -> Self {
                    Request::$variant(request)
                }
            }

            impl TypedRequest for proto::$request {
                type Reply = proto::$reply;
                const NAME: &'static str = $name;

                fn reply(response: Response) -> Result<Self::Reply, &'static str> {
                    match response {
                        Response::$answer(reply) => Ok(reply),
                        other => Err(name_of(&other)),
                    }
                }
            }
        )*

        fn name_of(response: &Response) -> &'static str {
            match response {
                $(Response::$answer(_) => $field,)*
                Response::Error(_) => "error",
            }
        }
    };
}

requests! {
    Open => Opened, Open, Opened, "opened", "to open a session";
    Step => Stepped, Step, Stepped, "stepped", "a step";
    Reset => ResetDone, Reset, Reset, "reset", "a reset";
    Snapshot => Snapshotted, Snapshot, Snapshot, "snapshot", "a snapshot";
    Restore => Restored, Restore, Restore, "restore", "to restore snapshots";
    Render => Rendered, Render, Render, "render", "a picture";
    Release => Released, Release, Release, "release", "to release environments";
    Act => Acted, Act, Act, "act", "to act";
    SavePlayer => PlayerSaved, SavePlayer, SavePlayer, "save_player", "to save a player";
    Resume => Resumed, Resume, Resumed, "resumed", "to resume a session";
}

/// A client's session on a server. Requests may be sent before earlier replies are received. Replies are received in
/// the order of their requests.
///
/// A session opened with [a lease](proto::Open::lease) survives the loss of its connection: it is resumed over a new
/// connection, with a warning in the log. The lease limits the number of requests whose replies are still due.
#[derive(Debug)]
pub struct Stream {
    connection: Connection,
    raw: RawStream,
    /// Replies that arrived while [`Stream::send_ahead`] waited, not yet received by the caller.
    arrived: VecDeque<SessionResponse>,
    /// Number of requests whose replies the caller has not received yet.
    unanswered: usize,
    /// The end of the stream, or a reply without a request, that arrived while no request was unanswered.
    unrequested: Option<Result<Option<SessionResponse>, Status>>,
    spin: AdaptiveSpin,
    lease: Option<ClientLease>,
}

/// The bidirectional gRPC stream of a session.
#[derive(Debug)]
struct RawStream {
    requests: mpsc::Sender<SessionRequest>,
    replies: Streaming<SessionResponse>,
}

impl RawStream {
    /// Starts a stream with its first request. The channel of requests has space for [`QUEUE_LENGTH`] + `room`
    /// requests. The first request is queued before the call starts, because a server may wait for that request before
    /// it accepts the call.
    ///
    /// The outer error means that the server did not answer in time. The inner error is the status with which the
    /// server refused the call.
    async fn begin(
        connection: &Connection,
        first: impl Into<Request>,
        room: usize,
    ) -> Result<Result<Self, Status>, ClientError> {
        let (requests, receiver) = mpsc::channel(QUEUE_LENGTH + room);
        let message = SessionRequest { request: Some(first.into()) };
        let limit = connection.timeouts().reply;
        if let Err(error) = requests.try_send(message) {
            return Ok(Err(Status::internal(error.to_string())));
        }
        let mut client = connection.client();
        let call = tokio::time::timeout(limit, client.session(ReceiverStream::new(receiver))).await;
        let call = call.map_err(|_| timed_out(connection.address(), proto::Open::NAME, limit))?;
        Ok(call.map(|call| Self { requests, replies: call.into_inner() }))
    }
}

impl Stream {
    /// Opens a session with its environments. Returns it with the server's reply.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's message, [`ClientError::Lost`], [`ClientError::TimedOut`],
    /// [`ClientError::Protocol`].
    pub async fn open(connection: &Connection, open: proto::Open) -> Result<(Self, proto::Opened), ClientError> {
        let raw = RawStream::begin(connection, open, 0).await?;
        let raw = raw.map_err(|status| lost(connection.address(), proto::Open::NAME, &status))?;
        let connection = connection.clone();
        let arrived = VecDeque::new();
        let spin = AdaptiveSpin::default();
        let mut stream = Self { connection, raw, arrived, unanswered: 1, unrequested: None, spin, lease: None };
        let mut opened = stream.receive::<proto::Open>().await?;
        opened.environment.iter_mut().for_each(escape_environment);
        stream.lease = ClientLease::from_proto(&opened);
        Ok((stream, opened))
    }

    /// Makes later waits for replies [spin](AdaptiveSpin) less if other threads want the core. Call it in a program
    /// that shares the cores with other busy programs.
    pub fn back_off_when_contended(&mut self) {
        self.spin.back_off_when_contended();
    }

    /// The address of the server.
    pub fn address(&self) -> &Address {
        self.connection.address()
    }

    /// Sends a request. Receive its reply with [`Stream::receive`].
    ///
    /// # Errors
    /// [`ClientError::Lost`] if the stream has ended. With a lease the request is kept, and sent again after the
    /// resumption.
    pub async fn send<A: TypedRequest>(&mut self, request: A) -> Result<(), ClientError> {
        self.note_request().await;
        let message = SessionRequest { request: Some(request.into()) };
        if let Some(lease) = &mut self.lease {
            // If the request is lost, `receive` sends it again after the session is resumed.
            lease.on_request(&message);
            let _ = self.raw.requests.send(message).await;
            return Ok(());
        }
        // Sending fails only if the channel is closed, which happens only after the stream has ended.
        let ended = |_| lost(self.connection.address(), A::NAME, &Status::unavailable("the stream has ended"));
        self.raw.requests.send(message).await.map_err(ended)
    }

    /// Sends one of many requests whose replies are received later. While the request waits to be sent, arriving
    /// replies are stored, because a server stops reading requests while its replies are not read. With a lease, which
    /// limits the number of unanswered requests, this is the same as [`Stream::send`].
    ///
    /// # Errors
    /// [`ClientError::Lost`] if the stream has ended.
    pub async fn send_ahead<A: TypedRequest>(&mut self, request: A) -> Result<(), ClientError> {
        if self.lease.is_some() {
            return self.send(request).await;
        }
        self.note_request().await;
        let message = SessionRequest { request: Some(request.into()) };
        let address = self.connection.address();
        let ended = || lost(address, A::NAME, &Status::unavailable("the stream has ended"));
        loop {
            let arrived = tokio::select! {
                biased;
                room = self.raw.requests.reserve() => {
                    room.map_err(|_| ended())?.send(message);
                    return Ok(());
                }
                arrived = self.raw.replies.message() => arrived,
            };
            let arrived = arrived.map_err(|status| lost(address, A::NAME, &status))?;
            self.arrived.push_back(arrived.ok_or_else(ended)?);
        }
    }

    /// Counts a request that will be sent. First checks for a reply without a request, which would otherwise be taken
    /// for the reply to this request.
    async fn note_request(&mut self) {
        if self.unanswered == 0 && self.unrequested.is_none() {
            let replies = &mut self.raw.replies;
            let came = poll_fn(|context| Poll::Ready(Pin::new(&mut *replies).poll_next(context))).await;
            if let Poll::Ready(came) = came {
                self.unrequested = Some(came.transpose());
            }
        }
        self.unanswered += 1;
    }

    /// Ends the session. Needed only with a lease: the server keeps a leased session until the lease ends, but ends any
    /// other session as soon as this value is dropped. Waits at most one second.
    pub async fn close(self) {
        let Self { raw: RawStream { requests, mut replies }, lease, .. } = self;
        drop(requests);
        if lease.is_some() {
            // A failure does no harm, since the lease ends by itself.
            let _ =
                tokio::time::timeout(CLOSE_TIMEOUT, async { while let Ok(Some(_)) = replies.message().await {} }).await;
        }
    }

    /// Waits for the reply to the oldest request whose reply was not received yet. That request must have had the type
    /// `A`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's message; the session continues. [`ClientError::Lost`],
    /// [`ClientError::TimedOut`] and [`ClientError::Protocol`]; the session is lost.
    pub async fn receive<A: TypedRequest>(&mut self) -> Result<A::Reply, ClientError> {
        if let Some(Ok(Some(_))) = &self.unrequested {
            return Err(self.mismatch::<A>("a second reply to an earlier request".into(), "one reply to each".into()));
        }
        self.unanswered = self.unanswered.saturating_sub(1);
        let message = match self.arrived.pop_front() {
            Some(arrived) => Some(arrived),
            None => self.message::<A>().await?,
        };
        match message.map(|message| message.response) {
            Some(Some(Response::Error(proto::Error { code, message }))) => {
                let (address, message) = (self.address().clone(), escape_lines(&message));
                Err(ClientError::Refused { address, request: A::NAME, code: Code::from_i32(code), message })
            }
            Some(Some(response)) => A::reply(response).map_err(|other| {
                let expected = format!("the reply to {}", A::NAME);
                self.mismatch::<A>(other.into(), expected)
            }),
            Some(None) => Err(self.mismatch::<A>("an empty reply".into(), "a reply".into())),
            None => Err(lost(self.address(), A::NAME, &Status::unavailable("the server ended the stream"))),
        }
    }

    /// Returns the next message from the server. With a lease, first resumes the session if its stream is lost.
    async fn message<A: TypedRequest>(&mut self) -> Result<Option<SessionResponse>, ClientError> {
        let limit = self.connection.timeouts().reply;
        let mut resumptions = 0;
        loop {
            let next = match self.unrequested.take() {
                Some(ended) => ended,
                None => {
                    let next = self.spin.until(self.raw.replies.message());
                    let next = tokio::time::timeout(limit, next).await;
                    next.map_err(|_| timed_out(self.connection.address(), A::NAME, limit))?
                }
            };
            let status = match next {
                Ok(message) => {
                    self.lease.iter_mut().for_each(ClientLease::on_reply);
                    return Ok(message);
                }
                Err(status) => status,
            };
            let error = lost(self.connection.address(), A::NAME, &status);
            // Resumes a session that has a lease and lost its connection, unless the server itself ended the stream
            // with a status. The number of resumptions without a reply in between is limited.
            let Some(lease) = self
                .lease
                .as_mut()
                .filter(|_| lease::is_of_connection(&status) && resumptions < MAX_RESUMES_WITHOUT_REPLY)
            else {
                return Err(error);
            };
            match lease.resume(&self.connection).await {
                Some(resumed) => {
                    tracing::warn!("{error}; resumed the session");
                    self.raw = resumed;
                    resumptions += 1;
                }
                None => {
                    self.lease = None;
                    return Err(error);
                }
            }
        }
    }

    /// Sends a request and waits for its reply. The replies to all earlier requests must have been received.
    ///
    /// # Errors
    /// The errors of [`Stream::receive`].
    pub async fn ask<A: TypedRequest>(&mut self, request: A) -> Result<A::Reply, ClientError> {
        // An error is ignored here: if the stream has ended, `receive` returns the reason.
        let _ = self.send(request).await;
        self.receive::<A>().await
    }

    /// Decodes the little-endian float32 array `field` of a reply to `A` into `out`.
    ///
    /// # Errors
    /// [`ClientError::Protocol`] if `bytes` does not have exactly the length of `out`.
    pub fn decode<A: TypedRequest>(
        &self,
        field: &'static str,
        bytes: &[u8],
        out: &mut [f32],
    ) -> Result<(), ClientError> {
        let (numbers, rest) = bytes.as_chunks::<4>();
        if numbers.len() != out.len() || !rest.is_empty() {
            let got = format!("{} bytes of {field}", bytes.len());
            return Err(self.mismatch::<A>(got, (out.len() * 4).to_string()));
        }
        out.iter_mut().zip(numbers).for_each(|(out, number)| *out = f32::from_le_bytes(*number));
        Ok(())
    }

    /// Creates the error for a reply to a request of type `A` that violates the protocol. `got` describes the reply,
    /// `expected` the reply that the protocol requires.
    pub fn mismatch<A: TypedRequest>(&self, got: String, expected: String) -> ClientError {
        ClientError::Protocol { address: self.address().clone(), request: A::NAME, got, expected }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use prost::Message as _;
    use prost_types::FileDescriptorSet;

    use crate::proto::DESCRIPTORS;

    /// Clients in other languages rely on this rule of the protocol.
    #[test]
    fn reply_has_the_number_of_its_request() {
        let files = FileDescriptorSet::decode(DESCRIPTORS).unwrap().file;
        let contract = files.iter().find(|file| file.package() == "perturb.v1").unwrap();
        let numbers = |message: &str| -> BTreeMap<i32, String> {
            let message = contract.message_type.iter().find(|other| other.name() == message).unwrap();
            message.field.iter().map(|field| (field.number(), field.name().to_owned())).collect()
        };
        let (requests, mut replies) = (numbers("SessionRequest"), numbers("SessionResponse"));
        assert_eq!(replies.remove(&15).as_deref(), Some("error"));
        assert!(requests.keys().eq(replies.keys()), "{requests:?} {replies:?}");
        for (request, reply) in requests.values().zip(replies.values()) {
            assert!(reply.starts_with(request), "{request} is answered with {reply}");
        }
    }
}
