//! The transport that the streams of both protocols share: one response for each request, in order, until the client's
//! end or the server's.

mod leased;

use super::{
    Error,
    handler::{Dialogue, Turn},
    lease::{Arrived, Numbers, One},
};
use crate::{
    pool::Follower,
    server::{
        auth::{self, Bearer, Held, Token},
        error::{ErrorCounters, RequestError, status},
        limits::Allowance,
        net::{
            access_log::{Access, BROKEN, CLOSED, Ended, GONE},
            peer_limiter::{Full, Place, Places},
        },
        shutdown::{Drain, Phase},
        transport::{
            self,
            message_reader::{Frames, Message, Stop},
            precheck::{Decoder, decoded_at_once},
        },
    },
};
use futures_util::{Stream, stream};
use perturb_protocol::Awake;
use std::{convert::Infallible, pin::Pin, time::Duration};
use tokio::{sync::mpsc, time::Instant};
use tonic::Status;

/// Responses as they come, or the status that ends the stream.
pub type Responses<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// What all sessions of the server are subject to: their number, how long they may be silent, and the shutdown.
#[derive(Clone)]
pub struct Sessions {
    places: Places,
    limits: Limits,
    decoder: Decoder,
    drain: Drain,
    counters: ErrorCounters,
    access: Access,
    leases: Numbers,
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
    pub fn new(
        places: Places,
        limits: Limits,
        drain: Drain,
        counters: ErrorCounters,
        access: Access,
        leases: Numbers,
    ) -> Self {
        Self { places, limits, decoder: Decoder::default(), drain, counters, access, leases }
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
        let place = self.admit(&requests);
        let place = if D::TAKES_UP { place.or_else(|refusal| self.spare(refusal)) } else { place };
        let place = place.map_err(|error| {
            self.count(&error, requests.bearer.as_ref());
            status(&error)
        })?;
        let sessions = Self { drain: self.drain.enter(), ..self.clone() };
        let (start, awake, ending) = (Instant::now(), Awake::default(), GONE);
        let conversation = Conversation {
            requests,
            ahead: None,
            came_ahead: false,
            reads_ahead: true,
            dialogue,
            sessions,
            start,
            was_open: false,
            known_open: start,
            spent: 0,
            awake,
            ending,
            resumed: 0,
            place,
        };
        // Polled by the connection: when the client is gone the stream is dropped, and what the dialogue holds with it,
        // unless it has a lease.
        let responses = stream::unfold(Some(Speaker::Own(Box::new(conversation))), |speaker| async {
            match speaker? {
                Speaker::Own(mut conversation) => match conversation.next().await? {
                    Ok(response) => Some((Ok(response), Some(conversation.turn()))),
                    Err(status) => Some((Err(status), None)),
                },
                Speaker::Leased(mut line) => {
                    let response = line.recv().await?;
                    let goes_on = response.is_ok().then_some(Speaker::Leased(line));
                    Some((response, goes_on))
                }
            }
        });
        Ok(Box::pin(responses))
    }

    /// Lets a stream in for which there is no place, if it might be one that takes up a session, which has a place.
    fn spare(&self, refusal: Error) -> Result<Seat, Error> {
        let is_full = matches!(
            refusal,
            Error::SessionsFull { .. } | Error::PeerFull { .. } | Error::Auth(auth::Error::QuotaExceeded { .. })
        );
        match self.leases.spare().filter(|_| is_full) {
            Some(spare) => Ok(Seat::Spare(spare, refusal)),
            None => Err(refusal),
        }
    }

    /// Counts an error, also for the token that the stream has.
    fn count(&self, error: &impl RequestError, bearer: Option<&Bearer>) {
        self.counters.count(error.kind());
        if let Some(bearer) = bearer {
            bearer.refused();
        }
    }

    fn admit(&self, requests: &Frames) -> Result<Seat, Error> {
        if self.phase() != Phase::Running {
            return Err(Error::Draining);
        }
        let place = self.places.take(requests.connection.as_ref().map(|connection| connection.peer));
        let place = place.map_err(|full| match full {
            Full::All(limit) => Error::SessionsFull { limit },
            Full::Peer(limit) => Error::PeerFull { limit },
        })?;
        Ok(Seat::Own(place, requests.bearer.as_ref().map(Token::session).transpose()?))
    }
}

/// A stream that goes on with another session, and leaves nothing to be told of.
const MOVED: &str = "moved";

/// Who makes a stream's responses.
enum Speaker<D: Dialogue> {
    /// The stream itself.
    Own(Box<Conversation<D>>),
    /// A task that outlives it.
    Leased(mpsc::Receiver<Result<D::Response, Status>>),
}

/// What a stream was let in on.
enum Seat {
    /// A place of its own, with that of its token.
    Own(#[expect(dead_code, reason = "held")] Place, #[expect(dead_code, reason = "held")] Option<Held>),
    /// That it takes up a session; otherwise this is its refusal.
    Spare(#[expect(dead_code, reason = "held")] One, Error),
}

/// A dialogue and its transport.
struct Conversation<D: Dialogue> {
    requests: Frames,
    /// What came while the request before it was being answered.
    ahead: Option<Result<Option<Message>, Stop<transport::Error>>>,
    /// Whether the present request came so, and may have begun then.
    came_ahead: bool,
    /// Whether anything may: not where it might have to be asked for again.
    reads_ahead: bool,
    dialogue: D,
    /// What this one is subject to; it counts as running as long as it holds this.
    sessions: Sessions,
    start: Instant,
    /// Whether its dialogue was open when it began to wait for the present request.
    was_open: bool,
    /// When it was last known to be open, at first the start: who is only refused does not begin.
    known_open: Instant,
    /// Its steps that its token was told of.
    spent: u64,
    awake: Awake,
    ending: &'static str,
    /// How often another stream took it up.
    resumed: u32,
    place: Seat,
}

impl<D: Dialogue> Conversation<D> {
    /// The next response; an error ends the stream, and so does the client's end.
    async fn next(&mut self) -> Option<Result<D::Response, Status>> {
        let answer = match self.request().await {
            Ok(Some(message)) => self.answer(message).await,
            Ok(None) | Err(Stop::Cancelled) => {
                self.ending = CLOSED;
                return None;
            }
            Err(stop) => Err(stop),
        };
        Some(self.told(answer))
    }

    /// What becomes of it after a response.
    fn turn(mut self: Box<Self>) -> Speaker<D> {
        let (line, receiver) = mpsc::channel(1);
        match self.dialogue.turn() {
            None => return Speaker::Own(self),
            Some(Turn::Leased(grant)) => leased::begin(*self, grant, line),
            Some(Turn::TakesUp(ticket)) => {
                self.ending = MOVED;
                // If whoever runs the session is gone by now, the line ends at once.
                let _ = ticket.arrival.send(Arrived { requests: self.requests.leave(), line });
            }
        }
        Speaker::Leased(receiver)
    }

    fn allowance(&self) -> Allowance {
        let allowance = self.dialogue.allowance();
        Allowance { bytes: allowance.bytes.min(self.sessions.limits.bytes), ..allowance }
    }

    /// The next request, none at the client's end. To be called again if its future was dropped: nothing is lost.
    async fn request(&mut self) -> Result<Option<Message>, Stop<D::Error>> {
        let Limits { handshake, idle, .. } = self.sessions.limits;
        let allowance = self.allowance();
        let bearer = self.requests.bearer.clone();
        self.was_open = self.dialogue.is_open();
        let Self { requests, ahead, came_ahead, awake, .. } = self;
        *came_ahead = ahead.is_some();
        let next = async {
            match ahead.take() {
                Some(request) => request,
                None => awake.until(requests.next(allowance)).await,
            }
        };
        let limit = if self.was_open { idle } else { Some(idle.map_or(handshake, |idle| idle.min(handshake))) };
        let passed = if self.was_open { Duration::ZERO } else { self.known_open.elapsed() };
        let late = || {
            let seconds = limit.map_or(0, |limit| limit.as_secs());
            Err(refused(Error::Idle { seconds }))
        };
        // Also where the next request is there already.
        if limit.is_some_and(|limit| passed > limit) {
            return late();
        }
        tokio::select! {
            biased; // the end comes first: a client that never pauses must not outlast it
            () = self.sessions.drain.closed() => Err(refused(Error::Draining)),
            error = revoked(bearer.as_ref()) => Err(refused(error)),
            request = next => request.map_err(|stop| stop.map(|error| Error::from(error).into())),
            () = silence(limit.map(|limit| limit.saturating_sub(passed))) => late(),
        }
    }

    /// The answer to a request. A stream that was let in to take up a session ends with its first refusal.
    async fn answer(&mut self, message: Message) -> Result<Result<D::Response, D::Error>, Stop<D::Error>> {
        match (self.respond(message).await?, &self.place) {
            (Err(refusal), Seat::Spare(..)) => Err(Stop::Refused(refusal)),
            (answer, _) => Ok(answer),
        }
    }

    async fn respond(&mut self, message: Message) -> Result<Result<D::Response, D::Error>, Stop<D::Error>> {
        if self.sessions.phase() != Phase::Running && !self.dialogue.is_open() {
            return Err(refused(Error::Draining));
        }
        // Until it is answered its bytes are kept.
        let (request, _share) = match message {
            Message::Whole(bytes, share) => (bytes, share),
            Message::Refused(error) => return Ok(self.undecoded(error)),
        };
        // Who is ahead of their rate waits, and nothing has happened yet. Nothing steps before a session is open; what
        // came ahead had no rate to keep.
        let bearer = self.requests.bearer.clone();
        let paced_bearer = bearer.as_ref().filter(|_| self.dialogue.is_open() && !self.came_ahead);
        tokio::select! {
            biased;
            paced = paced(paced_bearer) => match paced {
                Ok(()) => {}
                Err(error) => return Ok(self.undecoded(error)),
            },
            () = self.sessions.drain.closed() => return Err(refused(Error::Draining)),
            error = revoked(bearer.as_ref()) => return Err(refused(error)),
        }
        let request = match self.sessions.decoder.decode(request, D::FIELDS, self.allowance()).await? {
            Ok(request) => request,
            Err(error) => return Ok(self.undecoded(error)),
        };
        if let Seat::Spare(_, refusal) = &self.place
            && !D::takes_up(&request)
        {
            return Err(refused(refusal.clone()));
        }
        let follower = self.dialogue.follower(&request).filter(|_| self.reads_ahead);
        let allowance = self.allowance();
        let Self { dialogue, requests, ahead, .. } = self;
        tokio::select! {
            biased; // it mostly is there at once
            answer = dialogue.answer(request) => Ok(answer),
            error = revoked(bearer.as_ref()) => Err(refused(error)),
            never = read_ahead::<D>(requests, ahead, follower, allowance) => match never {},
        }
    }

    /// The response that an answer is; an error ends the stream.
    fn told(&mut self, answer: Result<Result<D::Response, D::Error>, Stop<D::Error>>) -> Result<D::Response, Status> {
        self.spend();
        if self.was_open || self.dialogue.is_open() {
            self.known_open = Instant::now();
        }
        match answer {
            Ok(Ok(response)) => Ok(response),
            Ok(Err(error)) => {
                self.count(&error);
                Ok(D::refusal(error))
            }
            Err(Stop::Refused(error)) => {
                self.end_by(&error);
                Err(status(&error))
            }
            Err(Stop::Broken(status)) => {
                self.ending = BROKEN;
                Err(status)
            }
            Err(Stop::Cancelled) => {
                self.ending = CLOSED;
                Err(Status::cancelled("the client has cancelled the stream"))
            }
        }
    }

    fn count(&self, error: &impl RequestError) {
        self.sessions.count(error, self.requests.bearer.as_ref());
    }

    /// The server ends it.
    fn end_by(&mut self, error: &impl RequestError) {
        self.count(error);
        self.ending = error.kind().reason();
    }

    fn undecoded(&self, error: impl Into<Error>) -> Result<D::Response, D::Error> {
        let error = D::Error::from(error.into());
        self.dialogue.undecoded(&error);
        Err(error)
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
        if self.ending == MOVED {
            return;
        }
        self.spend();
        self.sessions.access.ended(&Ended {
            peer: self.requests.connection.as_ref().map(|connection| connection.peer),
            token: self.requests.bearer.as_ref().map(|bearer| bearer.name()),
            protocol: D::PROTOCOL,
            about: self.dialogue.about(),
            time: self.start.elapsed(),
            resumed: (self.resumed > 0).then_some(self.resumed),
            ending: self.ending,
        });
    }
}

/// Takes the request that comes while another is answered, and tells the follower of it.
async fn read_ahead<D: Dialogue>(
    requests: &mut Frames,
    ahead: &mut Option<Result<Option<Message>, Stop>>,
    follower: Option<Follower>,
    allowance: Allowance,
) -> Infallible {
    if let Some(follower) = follower.filter(|_| ahead.is_none()) {
        let came = requests.next(allowance).await;
        if let Ok(Some(Message::Whole(bytes, _))) = &came
            && let Some(request) = decoded_at_once(bytes.clone(), D::FIELDS, allowance)
        {
            D::follow(&follower, request);
        }
        *ahead = Some(came);
    }
    std::future::pending().await
}

/// The session ends with this error.
fn refused<E: From<Error>>(error: impl Into<Error>) -> Stop<E> {
    Stop::Refused(error.into().into())
}

/// Resolves when the token is revoked, if there is one.
async fn revoked(bearer: Option<&Bearer>) -> auth::Error {
    match bearer {
        Some(bearer) => bearer.revoked().await,
        None => std::future::pending().await,
    }
}

/// Resolves when the token, if there is one, lets its environments step.
async fn paced(bearer: Option<&Bearer>) -> Result<(), auth::Error> {
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
