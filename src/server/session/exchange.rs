//! Reads a session's requests from its stream and has its handler answer them, with timeouts, rates and charges.

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
use tokio::{
    task::yield_now,
    time::{Instant, timeout},
};
use tonic::Status;

/// The ending of a session that existed only until its stream resumed another session. The access log omits such
/// sessions.
pub(super) const MOVED: &str = "moved";

/// The maximum time for which the end of a stream is delayed until the environments of its session are freed.
const MAX_CLOSE_TIME: Duration = Duration::from_secs(10);
/// The charge for a request that is refused before it is decoded, in steps.
const UNDECODED_PRICE: u64 = 1;

/// A session's handler, and the reader of the requests of its current stream.
pub(super) struct Exchange<H: SessionHandler> {
    pub(super) requests: MessageReader,
    /// A request that was read while the previous request was being answered.
    ahead: Option<Result<Option<Message>, StreamStop>>,
    /// Whether the current request was read ahead. If so, its step may already have started.
    was_read_ahead: bool,
    /// Whether a request may be read before the previous request is answered.
    pub(super) reads_ahead: bool,
    handler: H,
    counts: Arc<RequestCounters>,
    /// A handle to the server's sessions. The shutdown counts this session as running until the handle is dropped.
    pub(super) sessions: Sessions,
    start: Instant,
    /// Whether the session was open when it began to wait for the current request.
    was_open: bool,
    /// The last time at which the session was known to be open; at first the session's start. The handshake timeout
    /// counts from this time, so a refused request does not extend the timeout.
    known_open: Instant,
    /// The steps of the session for which its token has been charged so far.
    charged: u64,
    /// The price of requests for which the session's token has not been charged yet, in steps.
    price: u64,
    /// The final statistics of the session; `None` until it is closed.
    final_stats: Option<SessionStats>,
    spin: AdaptiveSpin,
    /// The reason for the session's end that the access log will state, unless it changes before the end.
    pub(super) ending: &'static str,
    /// The number of times that the session was resumed.
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
            was_read_ahead: false,
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
            spin: AdaptiveSpin::default(),
            ending: GONE,
            resumed: 0,
            admission,
        }
    }

    /// Returns the next request, or `None` after the client has closed the stream. Cancel safe: if the future is
    /// dropped, the next call continues reading.
    pub(super) async fn request(&mut self) -> Result<Option<Message>, StreamStop<H::Error>> {
        let SessionLimits { handshake, idle, .. } = self.sessions.limits;
        let limits = self.request_limits();
        let bearer = self.requests.bearer.clone();
        self.was_open = self.handler.is_open();
        let Self { requests, ahead, was_read_ahead, spin, handler, .. } = self;
        *was_read_ahead = ahead.is_some();
        let next = async {
            match ahead.take() {
                Some(request) => request,
                None => {
                    if handler.draws_ahead() {
                        yield_now().await; // the transport sends the last reply first
                        handler.draw_ahead();
                    }
                    spin.until(requests.next(limits)).await
                }
            }
        };
        let limit = if self.was_open { idle } else { Some(idle.map_or(handshake, |idle| idle.min(handshake))) };
        let elapsed = if self.was_open { Duration::ZERO } else { self.known_open.elapsed() };
        let timed_out = || {
            let seconds = limit.map_or(0, |limit| limit.as_secs());
            Err(refused(Error::Idle { seconds }))
        };
        // The timeout applies even if a request has already arrived.
        if limit.is_some_and(|limit| elapsed > limit) {
            return timed_out();
        }
        tokio::select! {
            biased; // the shutdown comes first, so a client that never pauses cannot delay it
            () = self.sessions.drain.closed() => Err(refused(Error::Draining)),
            error = revoked(bearer.as_ref()) => Err(refused(error)),
            request = next => request.map_err(|stop| stop.map(|error| Error::from(error).into())),
            () = sleep(limit.map(|limit| limit.saturating_sub(elapsed))) => timed_out(),
        }
    }

    /// Answers a request. A stream that was admitted only to resume a session ends at its first refused request.
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
        // Holds the request's memory reservation until the request is answered.
        let (request, _reservation) = match message {
            Message::Whole(bytes, reservation) => (bytes, reservation),
            Message::Refused(error) => return Ok(self.refuse_undecoded(error)),
        };
        // A client that exceeds its token's rate waits before its request is decoded. Requests are read ahead only for
        // tokens without a rate, so a request that was read ahead need not wait.
        let bearer = self.requests.bearer.clone();
        let was_open = self.handler.is_open();
        if let Err(error) = self.pace(bearer.as_ref().filter(|_| was_open && !self.was_read_ahead)).await? {
            return Ok(self.refuse_undecoded(error));
        }
        let request = match self.sessions.decoder.decode(request, H::FIELDS, self.request_limits()).await? {
            Ok(request) => request,
            Err(error) => return Ok(self.refuse_undecoded(error)),
        };
        // A stream that was admitted only for resuming must resume a session with its first request.
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
                return Ok(self.refuse_undecoded(error));
            }
            self.price += self.handler.price(&request);
        }
        // While the handler answers this request, the next one may be read, and the pool may begin it.
        let offer = if self.reads_ahead { self.handler.pipeline(&request) } else { None };
        let limits = self.request_limits();
        let Self { handler, counts, requests, ahead, .. } = self;
        tokio::select! {
            biased; // in most cases the answer is ready at the first poll
            answer = counts.answer(handler, request) => Ok(answer),
            error = revoked(bearer.as_ref()) => Err(refused(error)),
            never = read_ahead::<H>(requests, ahead, offer, limits) => match never {},
        }
    }

    /// Waits until the token's rate allows another request. Returns at once if there is no token or the token has no
    /// rate.
    async fn pace(&mut self, bearer: Option<&Bearer>) -> Result<Result<(), auth::Error>, StreamStop<H::Error>> {
        tokio::select! {
            biased;
            paced = wait_for_rate(bearer) => Ok(paced),
            () = self.sessions.drain.closed() => Err(refused(Error::Draining)),
            error = revoked(bearer) => Err(refused(error)),
        }
    }

    /// Has the handler free its resources, and keeps the final statistics.
    pub(super) async fn close(&mut self) {
        self.charge();
        self.final_stats = Some(self.handler.stats());
        if timeout(MAX_CLOSE_TIME, self.handler.close()).await.is_err() {
            tracing::warn!("a session ends before its environments are freed");
        }
    }

    /// Charges the token for an answered request, and returns the reply. If the answer is an error, counts the error
    /// and converts it to an in-band reply.
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

    /// Records why the session ends. Returns the status that ends its stream, or `None` if the client has gone.
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

    /// Counts and charges a request that is refused before it is decoded. Returns its error.
    fn refuse_undecoded<R>(&mut self, error: impl Into<Error>) -> Result<R, H::Error> {
        self.price += UNDECODED_PRICE;
        let error = H::Error::from(error.into());
        self.counts.count_undecoded(&error);
        Err(error)
    }

    /// Charges the token for the steps and requests since the last call of this function.
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

/// Reads the next request while the current one is being answered, and offers it to the pool. Never resolves, so this
/// branch never ends the surrounding `select!`.
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

/// Returns a [`StreamStop`] that ends a session with this error.
pub(super) fn refused<E: From<Error>>(error: impl Into<Error>) -> StreamStop<E> {
    StreamStop::Refused(error.into().into())
}

/// Resolves when the token is revoked. If there is no token, never resolves.
pub(super) async fn revoked(bearer: Option<&Bearer>) -> auth::Error {
    match bearer {
        Some(bearer) => bearer.revoked().await,
        None => std::future::pending().await,
    }
}

/// Resolves when the token's rate allows another step; immediately if there is no token.
async fn wait_for_rate(bearer: Option<&Bearer>) -> Result<(), auth::Error> {
    match bearer {
        Some(bearer) => bearer.acquire_steps().await,
        None => Ok(()),
    }
}

/// Resolves after `limit`. If there is no limit, never resolves.
async fn sleep(limit: Option<Duration>) {
    match limit {
        Some(limit) => tokio::time::sleep(limit).await,
        None => std::future::pending().await,
    }
}
