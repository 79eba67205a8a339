//! A session's stream, typed: every request has its reply.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use crate::address::Address;
use crate::awake::Awake;
use crate::connection::Connection;
use crate::error::{ClientError, lost, timed_out};
use crate::proto::{self, SessionRequest, SessionResponse, session_request::Request, session_response::Response};

/// Requests that may lie in the channel before they are sent.
const QUEUE: usize = 4;

/// A request of a session.
pub trait Ask: Into<Request> {
    /// What answers it.
    type Reply;
    /// What it is called in errors.
    const NAME: &'static str;

    /// Its reply in a response, or what the protocol calls another one that came instead.
    ///
    /// # Errors
    /// The other response's name.
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

            impl Ask for proto::$request {
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
}

/// One session. Requests may be sent ahead; replies are taken in the order of their requests.
#[derive(Debug)]
pub struct Stream {
    address: Address,
    limit: Duration,
    requests: mpsc::Sender<SessionRequest>,
    replies: Streaming<SessionResponse>,
    /// Replies that came while a request could not be sent.
    arrived: VecDeque<SessionResponse>,
    awake: Awake,
}

impl Stream {
    /// Opens environments.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's sentence, and the failures of a connection.
    pub async fn open(connection: &Connection, open: proto::Open) -> Result<(Self, proto::Opened), ClientError> {
        let (requests, receiver) = mpsc::channel(QUEUE);
        let (address, limit) = (connection.address().clone(), connection.patience().reply);
        let lost = |status: &Status| lost(&address, proto::Open::NAME, status);
        // The request lies in the channel before the call is made: a server may wait for it before it answers at all.
        let message = SessionRequest { request: Some(open.into()) };
        requests.try_send(message).map_err(|error| lost(&Status::internal(error.to_string())))?;
        let mut client = connection.client();
        let call = client.session(ReceiverStream::new(receiver));
        let replies = tokio::time::timeout(limit, call)
            .await
            .map_err(|_| timed_out(&address, proto::Open::NAME, limit))?
            .map_err(|status| lost(&status))?
            .into_inner();
        let mut stream = Self { address, limit, requests, replies, arrived: VecDeque::new(), awake: Awake::default() };
        let opened = stream.receive::<proto::Open>().await?;
        Ok((stream, opened))
    }

    /// Where the server is.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Sends a request.
    ///
    /// # Errors
    /// [`ClientError::Lost`].
    pub async fn send<A: Ask>(&self, request: A) -> Result<(), ClientError> {
        let message = SessionRequest { request: Some(request.into()) };
        // The channel has room for a request, and is closed only after the stream has ended.
        let ended = |_| lost(&self.address, A::NAME, &Status::unavailable("the stream has ended"));
        self.requests.send(message).await.map_err(ended)
    }

    /// Sends one of many requests whose replies are taken later. A server that has no room for replies reads no requests
    /// either: so those that come are kept while this one has to wait.
    ///
    /// # Errors
    /// [`ClientError::Lost`].
    pub async fn send_ahead<A: Ask>(&mut self, request: A) -> Result<(), ClientError> {
        let message = SessionRequest { request: Some(request.into()) };
        let ended = || lost(&self.address, A::NAME, &Status::unavailable("the stream has ended"));
        loop {
            let arrived = tokio::select! {
                biased;
                room = self.requests.reserve() => {
                    room.map_err(|_| ended())?.send(message);
                    return Ok(());
                }
                arrived = self.replies.message() => arrived,
            };
            let arrived = arrived.map_err(|status| lost(&self.address, A::NAME, &status))?;
            self.arrived.push_back(arrived.ok_or_else(ended)?);
        }
    }

    /// Takes the reply to the oldest request that has none yet, which must have been an `A`.
    ///
    /// # Errors
    /// [`ClientError::Refused`] with the server's sentence; then the session lives on. Otherwise the failures of a
    /// connection.
    pub async fn receive<A: Ask>(&mut self) -> Result<A::Reply, ClientError> {
        let message = match self.arrived.pop_front() {
            Some(arrived) => Some(arrived),
            None => tokio::time::timeout(self.limit, self.awake.until(self.replies.message()))
                .await
                .map_err(|_| timed_out(&self.address, A::NAME, self.limit))?
                .map_err(|status| lost(&self.address, A::NAME, &status))?,
        };
        match message.map(|message| message.response) {
            Some(Some(Response::Error(proto::Error { code, message }))) => {
                let address = self.address.clone();
                Err(ClientError::Refused { address, request: A::NAME, code: Code::from_i32(code), message })
            }
            Some(Some(response)) => A::reply(response).map_err(|other| {
                let expected = format!("the reply to {}", A::NAME);
                self.mismatch::<A>(other.into(), expected)
            }),
            Some(None) => Err(self.mismatch::<A>("an empty reply".into(), "a reply".into())),
            None => Err(lost(&self.address, A::NAME, &Status::unavailable("the server ended the stream"))),
        }
    }

    /// Sends a request and takes its reply.
    ///
    /// # Errors
    /// Those of [`Stream::receive`].
    pub async fn ask<A: Ask>(&mut self, request: A) -> Result<A::Reply, ClientError> {
        // If the stream has ended already, its status says why.
        let _ = self.send(request).await;
        self.receive::<A>().await
    }

    /// Little-endian f32 numbers, exactly as many as `out` takes.
    ///
    /// # Errors
    /// [`ClientError::Protocol`] if there are more or fewer.
    pub fn decode<A: Ask>(&self, field: &'static str, bytes: &[u8], out: &mut [f32]) -> Result<(), ClientError> {
        let (numbers, rest) = bytes.as_chunks::<4>();
        if numbers.len() != out.len() || !rest.is_empty() {
            let got = format!("{} bytes of {field}", bytes.len());
            return Err(self.mismatch::<A>(got, (out.len() * 4).to_string()));
        }
        out.iter_mut().zip(numbers).for_each(|(out, number)| *out = f32::from_le_bytes(*number));
        Ok(())
    }

    /// The error for a reply to an `A` that does not follow the protocol.
    pub fn mismatch<A: Ask>(&self, got: String, expected: String) -> ClientError {
        ClientError::Protocol { address: self.address.clone(), request: A::NAME, got, expected }
    }
}
