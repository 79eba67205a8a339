//! The transport that the streams of both protocols share: one response for each request, in order, until the client's
//! end or the server's.

use super::{
    access::{About, Access, Ended},
    drain::{Drain, Phase},
    fields::{Decoder, Field},
    frames::{Allowance, Frames, Message, Stop},
    peers::{Full, Place, Places},
    refusals::{self, Refusals},
    status::Refusal,
    tokens::{Bearer, Held, Token},
};
use futures_util::{Stream, stream};
use perturb_protocol::Awake;
use std::{future::Future, pin::Pin, time::Duration};
use tokio::time::Instant;
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
    /// What the protocol is called.
    const PROTOCOL: &'static str;

    /// What the client may send now.
    fn allowance(&self) -> Allowance;

    /// Whether it holds something that a shutdown should wait for.
    fn is_open(&self) -> bool;

    /// What has come of it so far.
    fn about(&self) -> About;

    /// Answers a request.
    fn answer(&mut self, request: Self::Request) -> impl Future<Output = Result<Self::Response, Refusal>> + Send;

    /// Takes note of a request that was refused before it was decoded.
    fn undecoded(&self, _refusal: &Refusal) {}

    /// The answer to a request that is refused.
    fn refusal(refusal: Refusal) -> Self::Response;
}

/// What all sessions of the server are subject to: their number, how long they may be silent, and the shutdown.
#[derive(Clone)]
pub struct Sessions {
    places: Places,
    limits: Limits,
    decoder: Decoder,
    drain: Drain,
    refusals: Refusals,
    access: Access,
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
    /// Sessions for which there are these places. What is refused and how they end is counted.
    pub fn new(places: Places, limits: Limits, drain: Drain, refusals: Refusals, access: Access) -> Self {
        Self { places, limits, decoder: Decoder::default(), drain, refusals, access }
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
        let admitted = self.admit(&requests);
        let _places = admitted.inspect_err(|refusal| self.refusals.count(refusal, requests.bearer.as_ref()))?;
        let sessions = Self { drain: self.drain.enter(), ..self.clone() };
        let (start, awake, ending) = (Instant::now(), Awake::default(), GONE);
        let conversation = Conversation { requests, dialogue, sessions, start, spent: 0, awake, ending, _places };
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

    fn admit(&self, requests: &Frames) -> Result<(Place, Option<Held>), Refusal> {
        if self.phase() != Phase::Running {
            return Err(Refusal::Draining);
        }
        let place = self.places.take(requests.connection.as_ref().map(|connection| connection.peer));
        let place = place.map_err(|full| match full {
            Full::All(limit) => Refusal::TooManySessions { limit },
            Full::Peer(limit) => Refusal::TooManyOfAPeer { limit },
        })?;
        Ok((place, requests.bearer.as_ref().map(Token::session).transpose()?))
    }
}

/// How a session ends whose client or connection is gone.
const GONE: &str = "gone";
/// One whose client has ended it.
const CLOSED: &str = "closed";
/// One whose requests were not to be understood.
const BROKEN: &str = "broken";

/// A dialogue and its transport.
struct Conversation<D: Dialogue> {
    requests: Frames,
    dialogue: D,
    /// What this one is subject to; it counts as running as long as it holds this.
    sessions: Sessions,
    start: Instant,
    /// Its steps that its token was told of.
    spent: u64,
    awake: Awake,
    ending: &'static str,
    _places: (Place, Option<Held>),
}

impl<D: Dialogue> Conversation<D> {
    /// The next response; an error ends the stream, and so does the client's end.
    async fn next(&mut self) -> Option<Result<D::Response, Status>> {
        let bearer = self.requests.bearer.clone();
        let answer = self.answer(bearer.as_ref()).await;
        self.spend();
        match answer {
            Ok(Some(Ok(response))) => Some(Ok(response)),
            Ok(Some(Err(refusal))) => {
                self.sessions.refusals.count(&refusal, bearer.as_ref());
                Some(Ok(D::refusal(refusal)))
            }
            Ok(None) => {
                self.ending = CLOSED;
                None
            }
            Err(Stop::Refused(refusal)) => {
                self.sessions.refusals.count(&refusal, bearer.as_ref());
                self.ending = refusals::reason(&refusal);
                Some(Err(refusal.into()))
            }
            Err(Stop::Broken(status)) => {
                self.ending = BROKEN;
                Some(Err(status))
            }
        }
    }

    /// The answer to the next request, none at the client's end.
    async fn answer(&mut self, bearer: Option<&Bearer>) -> Result<Option<Result<D::Response, Refusal>>, Stop> {
        let Limits { bytes, handshake, idle } = self.sessions.limits;
        let mut allowance = self.dialogue.allowance();
        allowance.bytes = allowance.bytes.min(bytes);
        let limit =
            if self.dialogue.is_open() { idle } else { Some(idle.map_or(handshake, |idle| idle.min(handshake))) };
        let request = tokio::select! {
            biased; // the end comes first: a client that never pauses must not outlast it
            () = self.sessions.drain.closed() => return Err(Stop::Refused(Refusal::Draining)),
            refusal = revoked(bearer) => return Err(Stop::Refused(refusal)),
            request = self.awake.until(self.requests.next(allowance)) => match request? {
                Some(request) => request,
                None => return Ok(None),
            },
            () = silence(limit) => {
                let seconds = limit.map_or(0, |limit| limit.as_secs());
                return Err(Stop::Refused(Refusal::Idle { seconds }));
            }
        };
        if self.sessions.phase() != Phase::Running && !self.dialogue.is_open() {
            return Err(Stop::Refused(Refusal::Draining));
        }
        // Until it is answered its bytes are kept.
        let (request, _share) = match request {
            Message::Whole(bytes, share) => (bytes, share),
            Message::Refused(refusal) => return Ok(Some(self.undecoded(refusal))),
        };
        // Who is ahead of their rate waits, and nothing has happened yet.
        tokio::select! {
            biased;
            turn = turn(bearer) => match turn {
                Ok(()) => {}
                Err(refusal) => return Ok(Some(self.undecoded(refusal))),
            },
            () = self.sessions.drain.closed() => return Err(Stop::Refused(Refusal::Draining)),
            refusal = revoked(bearer) => return Err(Stop::Refused(refusal)),
        }
        match self.sessions.decoder.decode(request, D::FIELDS, allowance).await? {
            Ok(request) => tokio::select! {
                biased; // it mostly is there at once
                response = self.dialogue.answer(request) => Ok(Some(response)),
                refusal = revoked(bearer) => Err(Stop::Refused(refusal)),
            },
            Err(refusal) => Ok(Some(self.undecoded(refusal))),
        }
    }

    fn undecoded(&self, refusal: Refusal) -> Result<D::Response, Refusal> {
        self.dialogue.undecoded(&refusal);
        Err(refusal)
    }

    /// Tells its token of the steps that it was not told of.
    fn spend(&mut self) {
        if let Some(bearer) = &self.requests.bearer {
            let steps = self.dialogue.about().steps;
            bearer.stepped(steps.saturating_sub(self.spent));
            self.spent = steps;
        }
    }
}

impl<D: Dialogue> Drop for Conversation<D> {
    fn drop(&mut self) {
        self.spend();
        self.sessions.access.ended(&Ended {
            peer: self.requests.connection.as_ref().map(|connection| connection.peer),
            token: self.requests.bearer.as_ref().map(|bearer| bearer.name()),
            protocol: D::PROTOCOL,
            about: self.dialogue.about(),
            time: self.start.elapsed(),
            ending: self.ending,
        });
    }
}

/// Resolves when the token is revoked, if there is one.
async fn revoked(bearer: Option<&Bearer>) -> Refusal {
    match bearer {
        Some(bearer) => bearer.revoked().await,
        None => std::future::pending().await,
    }
}

/// Resolves when the token, if there is one, lets its environments step.
async fn turn(bearer: Option<&Bearer>) -> Result<(), Refusal> {
    match bearer {
        Some(bearer) => bearer.turn().await,
        None => Ok(()),
    }
}

/// Resolves after that long, or never.
async fn silence(limit: Option<Duration>) {
    match limit {
        Some(limit) => tokio::time::sleep(limit).await,
        None => std::future::pending().await,
    }
}
