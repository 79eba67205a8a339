//! The exchange of requests and replies between a stream and the handler of its session.

use super::{
    Error,
    admission::{Admission, SessionLimits, Sessions},
    handler::{Reply, SessionHandler},
    instrumented::RequestCounters,
};
use crate::server::{
    auth::{self, Bearer},
    error::{RequestError, status},
    limits::RequestLimits,
    net::access_log::{BROKEN, GONE, SessionRecord, SessionStats},
    shutdown::ShutdownPhase,
    transport::{
        message_reader::{Message, MessageReader, StreamStop},
        precheck::decoded_at_once,
    },
};
use perturb_protocol::AdaptiveSpin;
use std::{convert::Infallible, sync::Arc, time::Duration};
use tokio::time::{Instant, timeout};
use tonic::Status;

/// The ending of the temporary session whose stream went over to a resumed one. It has no line in the access log.
pub(super) const MOVED: &str = "moved";

/// The time in which a session's environments must be freed before the end of its stream is sent.
const MAX_CLOSE_TIME: Duration = Duration::from_secs(10);
/// The price of a request that is refused before it is decoded, in steps.
const UNDECODED_PRICE: u64 = 1;

/// A session's handler, and the requests of the stream that the session has now.
pub(super) struct Exchange<H: SessionHandler> {
    pub(super) requests: MessageReader,
    /// The request that was read ahead, while the previous one was being answered.
    ahead: Option<Result<Option<Message>, StreamStop>>,
    /// Whether the present request was read ahead. Its step may have begun then.
    came_ahead: bool,
    /// Whether requests may be read before the previous one is answered.
    pub(super) reads_ahead: bool,
    handler: H,
    counts: Arc<RequestCounters>,
    /// The server's sessions. The session counts as running as long as it holds this view.
    pub(super) sessions: Sessions,
    start: Instant,
    /// Whether the session was open when it began to wait for the present request.
    was_open: bool,
    /// Last time the session was known to be open. The handshake timeout counts from here, so refused requests do not
    /// extend it.
    known_open: Instant,
    /// The session's steps that its token has been charged for.
    charged: u64,
    /// The price of requests that its token has not been charged for, in steps.
    price: u64,
    /// The statistics of the session, once it is closed.
    final_stats: Option<SessionStats>,
    awake: AdaptiveSpin,
    /// The ending that the access log will have, unless it changes before the session ends.
    pub(super) ending: &'static str,
    /// The number of streams that resumed the session.
    pub(super) resumed: u32,
    admission: Admission,
}

impl<H: SessionHandler> Exchange<H> {
    pub(super) fn new(
        requests: MessageReader,
        handler: H,
        counts: Arc<RequestCounters>,
        sessions: Sessions,
        admission: Admission,
    ) -> Self {
        let start = Instant::now();
        Self {
            requests,
            ahead: None,
            came_ahead: false,
            reads_ahead: true,
            handler,
            counts,
            sessions,
            start,
            was_open: false,
            known_open: start,
            charged: 0,
            price: 0,
            final_stats: None,
            awake: AdaptiveSpin::default(),
            ending: GONE,
            resumed: 0,
            admission,
        }
    }

    /// Returns the next request, or `None` after the client has closed the stream. If the future is dropped, no data is
    /// lost: the next call continues.
    pub(super) async fn request(&mut self) -> Result<Option<Message>, StreamStop<H::Error>> {
        let SessionLimits { handshake, idle, .. } = self.sessions.limits;
        let limits = self.request_limits();
        let bearer = self.requests.bearer.clone();
        self.was_open = self.handler.is_open();
        let Self { requests, ahead, came_ahead, awake, .. } = self;
        *came_ahead = ahead.is_some();
        let next = async {
            match ahead.take() {
                Some(request) => request,
                None => awake.until(requests.next(limits)).await,
            }
        };
        let limit = if self.was_open { idle } else { Some(idle.map_or(handshake, |idle| idle.min(handshake))) };
        let passed = if self.was_open { Duration::ZERO } else { self.known_open.elapsed() };
        let late = || {
            let seconds = limit.map_or(0, |limit| limit.as_secs());
            Err(refused(Error::Idle { seconds }))
        };
        // The timeout applies even if a request has already arrived.
        if limit.is_some_and(|limit| passed > limit) {
            return late();
        }
        tokio::select! {
            biased; // the end comes first: a client that never pauses must not outlast it
            () = self.sessions.drain.closed() => Err(refused(Error::Draining)),
            error = revoked(bearer.as_ref()) => Err(refused(error)),
            request = next => request.map_err(|stop| stop.map(|error| Error::from(error).into())),
            () = sleep(limit.map(|limit| limit.saturating_sub(passed))) => late(),
        }
    }

    /// Answers a request. A stream that was admitted only to resume a session ends with its first refusal.
    pub(super) async fn answer(
        &mut self,
        message: Message,
    ) -> Result<Result<Reply<H::Response>, H::Error>, StreamStop<H::Error>> {
        match (self.respond(message).await?, &self.admission) {
            (Err(error), Admission::ResumeOnly(..)) => Err(StreamStop::Refused(error)),
            (answer, _) => Ok(answer),
        }
    }

    async fn respond(
        &mut self,
        message: Message,
    ) -> Result<Result<Reply<H::Response>, H::Error>, StreamStop<H::Error>> {
        if self.sessions.phase() != ShutdownPhase::Running && !self.handler.is_open() {
            return Err(refused(Error::Draining));
        }
        // The request's reservation is held until it is answered.
        let (request, _share) = match message {
            Message::Whole(bytes, share) => (bytes, share),
            Message::Refused(error) => return Ok(self.undecoded(error)),
        };
        // A client that is ahead of its rate waits before its request is decoded. A request is read ahead only if its
        // token has no rate, so it does not wait.
        let bearer = self.requests.bearer.clone();
        let was_open = self.handler.is_open();
        if let Err(error) = self.pace(bearer.as_ref().filter(|_| was_open && !self.came_ahead)).await? {
            return Ok(self.undecoded(error));
        }
        let request = match self.sessions.decoder.decode(request, H::FIELDS, self.request_limits()).await? {
            Ok(request) => request,
            Err(error) => return Ok(self.undecoded(error)),
        };
        let resumes = H::RESUMES.is_some_and(|resumes| resumes(&request));
        if let Admission::ResumeOnly(_, refusal) = &self.admission
            && !resumes
        {
            return Err(refused(refusal.clone()));
        }
        if let Some(bearer) = &bearer {
            // A request that resumes a session does not wait for the token's rate.
            if !was_open
                && !resumes
                && let Err(error) = self.pace(Some(bearer)).await?
            {
                return Ok(self.undecoded(error));
            }
            self.price += self.handler.price(&request);
        }
        let offer = if self.reads_ahead { self.handler.pipeline(&request) } else { None };
        let limits = self.request_limits();
        let Self { handler, counts, requests, ahead, .. } = self;
        tokio::select! {
            biased; // the answer is mostly there at once
            answer = counts.answer(handler, request) => Ok(answer),
            error = revoked(bearer.as_ref()) => Err(refused(error)),
            never = read_ahead::<H>(requests, ahead, offer, limits) => match never {},
        }
    }

    /// Waits until the token's rate, if it has one, has covered what it was charged for.
    async fn pace(&mut self, bearer: Option<&Bearer>) -> Result<Result<(), auth::Error>, StreamStop<H::Error>> {
        tokio::select! {
            biased;
            paced = wait_for_rate(bearer) => Ok(paced),
            () = self.sessions.drain.closed() => Err(refused(Error::Draining)),
            error = revoked(bearer) => Err(refused(error)),
        }
    }

    /// Frees the resources of the handler.
    pub(super) async fn close(&mut self) {
        self.charge();
        self.final_stats = Some(self.handler.stats());
        if timeout(MAX_CLOSE_TIME, self.handler.close()).await.is_err() {
            tracing::warn!("a session ends before its environments are freed");
        }
    }

    /// Counts and charges an answer, and turns an error into its in-band reply.
    pub(super) fn finish(&mut self, answer: Result<Reply<H::Response>, H::Error>) -> Reply<H::Response> {
        self.charge();
        if self.was_open || self.handler.is_open() {
            self.known_open = Instant::now();
        }
        answer.unwrap_or_else(|error| {
            self.count(&error);
            Reply::new(H::error_response(error))
        })
    }

    /// Records why the session ends. Returns the status of its stream's end, or `None` if the client is gone.
    pub(super) fn end(&mut self, stop: StreamStop<H::Error>) -> Option<Status> {
        match stop {
            StreamStop::Refused(error) => {
                self.end_by(&error);
                Some(status(&error))
            }
            StreamStop::Broken(status) => {
                self.ending = BROKEN;
                Some(status)
            }
            StreamStop::Cancelled => None,
        }
    }

    /// Records that the server ends the session with this error.
    pub(super) fn end_by(&mut self, error: &impl RequestError) {
        self.count(error);
        self.ending = error.kind().reason();
    }

    fn request_limits(&self) -> RequestLimits {
        let limits = self.handler.request_limits();
        RequestLimits { bytes: limits.bytes.min(self.sessions.limits.bytes), ..limits }
    }

    fn count(&self, error: &impl RequestError) {
        self.sessions.count(error, self.requests.bearer.as_ref());
    }

    /// Refuses a request that was not decoded.
    fn undecoded<R>(&mut self, error: impl Into<Error>) -> Result<R, H::Error> {
        self.price += UNDECODED_PRICE;
        let error = H::Error::from(error.into());
        self.counts.count_undecoded(&error);
        Err(error)
    }

    /// Charges the token for the steps and requests since the last call.
    fn charge(&mut self) {
        if let Some(bearer) = &self.requests.bearer {
            let steps = self.final_stats.unwrap_or_else(|| self.handler.stats()).steps;
            bearer.charge(steps.saturating_sub(self.charged), std::mem::take(&mut self.price));
            self.charged = steps;
        }
    }
}

impl<H: SessionHandler> Drop for Exchange<H> {
    fn drop(&mut self) {
        if self.ending == MOVED {
            return;
        }
        self.charge();
        self.sessions.access.record(&SessionRecord {
            peer: self.requests.connection.as_ref().map(|connection| connection.peer),
            token: self.requests.bearer.as_ref().map(|bearer| bearer.name()),
            protocol: H::PROTOCOL,
            stats: self.final_stats.unwrap_or_else(|| self.handler.stats()),
            time: self.start.elapsed(),
            resumed: (self.resumed > 0).then_some(self.resumed),
            ending: self.ending,
        });
    }
}

/// Reads the next request while another is answered, and offers it to the pool. Never resolves, so that a `select!`
/// always waits for the answer.
async fn read_ahead<H: SessionHandler>(
    requests: &mut MessageReader,
    ahead: &mut Option<Result<Option<Message>, StreamStop>>,
    offer: Option<impl FnOnce(H::Request)>,
    limits: RequestLimits,
) -> Infallible {
    if let Some(offer) = offer.filter(|_| ahead.is_none()) {
        let next = requests.next(limits).await;
        if let Ok(Some(Message::Whole(bytes, _))) = &next
            && let Some(request) = decoded_at_once(bytes.clone(), H::FIELDS, limits)
        {
            offer(request);
        }
        *ahead = Some(next);
    }
    std::future::pending().await
}

/// Ends a session with this error.
pub(super) fn refused<E: From<Error>>(error: impl Into<Error>) -> StreamStop<E> {
    StreamStop::Refused(error.into().into())
}

/// Resolves when the token is revoked. Never resolves without a token.
pub(super) async fn revoked(bearer: Option<&Bearer>) -> auth::Error {
    match bearer {
        Some(bearer) => bearer.revoked().await,
        None => std::future::pending().await,
    }
}

/// Resolves when the token's rate allows another step, at once without a token.
async fn wait_for_rate(bearer: Option<&Bearer>) -> Result<(), auth::Error> {
    match bearer {
        Some(bearer) => bearer.acquire_steps().await,
        None => Ok(()),
    }
}

/// Resolves after `limit`. Never resolves without one.
async fn sleep(limit: Option<Duration>) {
    match limit {
        Some(limit) => tokio::time::sleep(limit).await,
        None => std::future::pending().await,
    }
}
