//! The transport that the streams of both protocols share: one response for each request, in order, until the client's
//! end or the server's.

use super::{
    drain::{Drain, Phase},
    fields::{Decoder, Field},
    frames::{Allowance, Frames, Message},
    peers::{Full, Place, Places},
    status::Refusal,
    tokens::{Bearer, Held, Token},
};
use futures_util::{Stream, stream};
use std::{future::Future, pin::Pin, time::Duration};
use tonic::Status;

/// The most bytes of a request before a session is open: enough for thousands of groups, and little enough that all
/// sessions may come so far.
pub const MOST_BYTES_BEFORE_OPEN: usize = 64 << 10;

/// Responses as they come, or the status that ends the stream.
pub type Responses<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// The server's part of a conversation. Dropping it frees what it holds.
pub trait Dialogue: Send + 'static {
    /// What the client sends.
    type Request: prost::Message + Default + 'static;
    /// What it gets.
    type Response: Send + 'static;
    /// The parts of a request that are counted before it is decoded.
    const FIELDS: &'static [Field];

    /// What the client may send now.
    fn allowance(&self) -> Allowance;

    /// Whether it holds something that a shutdown should wait for.
    fn is_open(&self) -> bool;

    /// Answers a request.
    fn answer(&mut self, request: Self::Request) -> impl Future<Output = Self::Response> + Send;

    /// Answers a request that is not decoded.
    fn refuse(&self, refusal: Refusal) -> Self::Response;
}

/// What all sessions of the server are subject to: their number, how long they may be silent, and the shutdown.
#[derive(Clone)]
pub struct Sessions {
    places: Places,
    limits: Limits,
    decoder: Decoder,
    drain: Drain,
}

/// What a session may do.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// The most bytes of a request.
    pub bytes: usize,
    /// How long it may be silent before it is open.
    pub handshake: Duration,
    /// How long it may be silent when it is open; none: for ever.
    pub idle: Option<Duration>,
}

impl Sessions {
    /// Sessions for which there are these places.
    pub fn new(places: Places, limits: Limits, drain: Drain) -> Self {
        Self { places, limits, decoder: Decoder::default(), drain }
    }

    /// How far the shutdown is.
    pub fn phase(&self) -> Phase {
        self.drain.phase()
    }

    /// Begins a session: the dialogue answers what the requests' frames bring.
    ///
    /// # Errors
    /// If the server is shutting down or has no room for another session, or its token may have no more.
    pub fn begin<D: Dialogue>(&self, requests: Frames, dialogue: D) -> Result<Responses<D::Response>, Status> {
        if self.phase() != Phase::Running {
            return Err(Refusal::Draining.into());
        }
        let place = self.places.take(requests.connection.as_ref().map(|connection| connection.peer));
        let place = place.map_err(|full| match full {
            Full::All(limit) => Refusal::TooManySessions { limit },
            Full::Peer(limit) => Refusal::TooManyOfAPeer { limit },
        })?;
        let held = requests.bearer.as_ref().map(Token::session).transpose()?;
        let sessions = Self { drain: self.drain.enter(), ..self.clone() };
        let conversation = Conversation { requests, dialogue, sessions, _place: place, _held: held };
        // Polled by the connection: when the client is gone the stream is dropped, and what the dialogue holds with it.
        let responses = stream::unfold(Some(conversation), |conversation| async {
            let mut conversation = conversation?;
            match conversation.next().await? {
                Ok(response) => Some((Ok(response), Some(conversation))),
                Err(status) => Some((Err(status), None)),
            }
        });
        Ok(Box::pin(responses))
    }
}

/// A dialogue and its transport.
struct Conversation<D: Dialogue> {
    requests: Frames,
    dialogue: D,
    /// What this one is subject to; it counts as running as long as it holds this.
    sessions: Sessions,
    _place: Place,
    _held: Option<Held>,
}

impl<D: Dialogue> Conversation<D> {
    /// The next response; an error ends the stream, and so does the client's end.
    async fn next(&mut self) -> Option<Result<D::Response, Status>> {
        let Limits { bytes, handshake, idle } = self.sessions.limits;
        let mut allowance = self.dialogue.allowance();
        allowance.bytes = allowance.bytes.min(bytes);
        let limit =
            if self.dialogue.is_open() { idle } else { Some(idle.map_or(handshake, |idle| idle.min(handshake))) };
        let bearer = self.requests.bearer.clone();
        let request = tokio::select! {
            biased; // the end comes first: a client that never pauses must not outlast it
            () = self.sessions.drain.closed() => return Some(Err(Refusal::Draining.into())),
            refusal = revoked(bearer.as_ref()) => return Some(Err(refusal.into())),
            request = self.requests.next(allowance) => match request {
                Ok(request) => request?,
                Err(status) => return Some(Err(status)),
            },
            () = silence(limit) => {
                let seconds = limit.map_or(0, |limit| limit.as_secs());
                return Some(Err(Refusal::Idle { seconds }.into()));
            }
        };
        if self.sessions.phase() != Phase::Running && !self.dialogue.is_open() {
            return Some(Err(Refusal::Draining.into()));
        }
        // Until it is answered its bytes are kept.
        let (request, _share) = match request {
            Message::Whole(bytes, share) => (bytes, share),
            Message::Refused(refusal) => return Some(Ok(self.dialogue.refuse(refusal))),
        };
        match self.sessions.decoder.decode(request, D::FIELDS, allowance).await {
            Ok(Ok(request)) => Some(tokio::select! {
                biased; // it mostly is there at once
                response = self.dialogue.answer(request) => Ok(response),
                refusal = revoked(bearer.as_ref()) => Err(refusal.into()),
            }),
            Ok(Err(refusal)) => Some(Ok(self.dialogue.refuse(refusal))),
            Err(status) => Some(Err(status)),
        }
    }
}

/// Resolves when the token is revoked, if there is one.
async fn revoked(bearer: Option<&Bearer>) -> Refusal {
    match bearer {
        Some(bearer) => bearer.revoked().await,
        None => std::future::pending().await,
    }
}

/// Resolves after that long, or never.
async fn silence(limit: Option<Duration>) {
    match limit {
        Some(limit) => tokio::time::sleep(limit).await,
        None => std::future::pending().await,
    }
}
