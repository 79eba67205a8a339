//! The task that runs a session. A session without a lease ends with its stream. A session with a lease outlives its
//! stream for a while, and another stream may attach to it. If such a session loses its stream while it answers a
//! request, it completes the request. It stores its last replies, so that it can send them again.

use super::{
    Error,
    admission::Sessions,
    exchange::{Exchange, MOVED, refused, revoked},
    handler::{Reply, SessionHandler, StreamHandover},
    instrumented::RequestCounters,
    lease::{self, LeaseGuard, OutgoingResponse, ResponseSender, ResumeAccepted, ResumeRequest, ResumingStream},
    replay_buffer::ReplayBuffer,
};
use crate::server::{
    error::{ErrorKind, RequestError, status},
    net::access_log::{CLOSED, GONE, LEASE_OVER},
    transport::{
        budget::MemoryReservation,
        message_reader::{Message, MessageReader, StreamStop},
    },
};
use futures_util::{Stream, stream};
use prost::Message as _;
use std::{
    future::Future,
    pin::{Pin, pin},
    sync::Arc,
};
use tokio::{
    runtime::Handle,
    sync::{
        mpsc::{self, error::TrySendError},
        oneshot,
    },
    time::{Instant, sleep_until},
};
use tonic::Status;

/// The maximum total length of a session's stored replies, bytes. The last reply is stored even if it is longer. A
/// client that has missed more than this should continue from a snapshot.
const MAX_STORED_BYTES: usize = 4 << 20;
/// The memory that a stored reply takes in addition to its encoded length, bytes.
const REPLY_OVERHEAD_BYTES: usize = 512;

/// The responses of a session as a stream. An error is the status that ends it.
pub type Responses<R> = Pin<Box<dyn Stream<Item = Result<R, Status>> + Send>>;

impl Sessions {
    /// Starts a session in a new task. There `handler` answers the requests that `requests` reads from the session's
    /// stream. Returns the responses.
    ///
    /// # Errors
    /// A status, if the server is shutting down or full, or the quota of the stream's token is used up.
    pub fn begin<H: SessionHandler>(
        &self,
        requests: MessageReader,
        handler: H,
        counts: &Arc<RequestCounters>,
    ) -> Result<Responses<H::Response>, Status> {
        let admission = self.admit(&requests, H::RESUMES.is_some()).map_err(|error| {
            self.count(&error, requests.bearer.as_ref());
            status(&error)
        })?;
        let (responses, mut received) = mpsc::channel::<Result<OutgoingResponse<H::Response>, Status>>(1);
        let pending_reservations = requests.pending_reservations.clone();
        let exchange = Exchange::new(requests, handler, Arc::clone(counts), self.enter(), admission);
        SessionDriver { exchange, lease: None }.spawn(&Handle::current(), responses);
        let stream = stream::poll_fn(move |context| {
            received.poll_recv(context).map(|response| {
                Some(response?.map(|OutgoingResponse { response, memory }| {
                    memory.into_iter().for_each(|reservation| pending_reservations.push(reservation));
                    response
                }))
            })
        });
        Ok(Box::pin(stream))
    }
}

struct SessionDriver<H: SessionHandler> {
    exchange: Exchange<H>,
    lease: Option<ActiveLease<H::Response>>,
}

/// A session's lease, and the replies that its client may not have received.
struct ActiveLease<R> {
    grant: LeaseGuard<R>,
    stored: ReplayBuffer<StoredReply<R>>,
    /// The number of the last reply that was sent on the current stream, or that the client had received before it
    /// resumed the session on this stream.
    sent: u64,
}

struct StoredReply<R> {
    response: R,
    /// The memory reservation for storing the reply. If it is `None`, the reply is dropped as soon as it is sent.
    memory: Option<MemoryReservation>,
    /// The memory reservation that the handler made for the response. This reservation is passed on when the response
    /// is first sent.
    outgoing: Option<MemoryReservation>,
}

/// The relation of a session to its stream.
enum Attachment<R> {
    /// The session has a stream; its responses go to this sender.
    Attached(ResponseSender<R>),
    /// The session has no stream. If there is a receiver, it will receive a stream whose resume request was accepted.
    Detached(Option<Resuming<R>>),
    /// A stream has resumed the session. The session continues on this runtime, and its responses go to this sender.
    Resumed(Handle, ResponseSender<R>),
    /// The session has ended.
    Ended,
}

type Resuming<R> = oneshot::Receiver<ResumingStream<R>>;

impl<H: SessionHandler> SessionDriver<H> {
    /// Runs the session on `runtime`, on which its stream is served.
    fn spawn(self, runtime: &Handle, responses: ResponseSender<H::Response>) {
        runtime.spawn(self.run(responses));
    }

    async fn run(mut self, responses: ResponseSender<H::Response>) {
        let mut attachment = Attachment::Attached(responses);
        loop {
            attachment = match attachment {
                Attachment::Attached(responses) => match self.run_attached(&responses).await {
                    Attachment::Ended => return self.close(responses).await,
                    next => next,
                },
                Attachment::Detached(resuming) => self.run_detached(resuming).await,
                Attachment::Resumed(runtime, responses) => return self.spawn(&runtime, responses),
                Attachment::Ended => return,
            };
        }
    }

    /// Frees the session's resources before the client sees the end of the stream, so the client can open another
    /// session immediately.
    async fn close(mut self, responses: ResponseSender<H::Response>) {
        self.exchange.close().await;
        drop(self);
        drop(responses);
    }

    /// Answers the requests of the current stream until the stream is lost or replaced, or the session ends.
    async fn run_attached(&mut self, responses: &ResponseSender<H::Response>) -> Attachment<H::Response> {
        let mut closed = pin!(responses.closed());
        loop {
            while self.lease.as_ref().is_some_and(|lease| lease.sent < lease.stored.last()) {
                let permit = match self.reserve_send(responses).await {
                    Ok(permit) => permit,
                    Err(attachment) => return attachment,
                };
                if let Some(response) = self.lease.as_mut().and_then(ActiveLease::next) {
                    permit.send(Ok(response));
                }
            }
            let Self { exchange, lease } = self;
            let message = tokio::select! {
                biased; // if the client closed the stream and then its connection, the log says "closed", not "gone"
                resume = resume_request(lease) => match self.accept_resume(resume) {
                    Some(resuming) => return self.supersede(responses, resuming),
                    None => continue,
                },
                request = exchange.request() => match request {
                    Ok(Some(message)) => message,
                    Ok(None) => {
                        exchange.ending = CLOSED;
                        return Attachment::Ended;
                    }
                    Err(stop) => return self.on_stop(responses, stop),
                },
                () = &mut closed => return self.detach(None),
            };
            if let Err(attachment) = self.respond(message, responses, closed.as_mut()).await {
                return attachment;
            }
        }
    }

    /// Answers a request. If the stream is lost meanwhile, a session without a lease abandons the request.
    async fn respond(
        &mut self,
        message: Message,
        responses: &ResponseSender<H::Response>,
        closed: Pin<&mut impl Future<Output = ()>>,
    ) -> Result<(), Attachment<H::Response>> {
        if let Some(lease) = &mut self.lease {
            lease.stored.on_request();
            match self.exchange.answer(message).await {
                Ok(answer) => self.store_reply(answer),
                Err(stop) => return Err(self.on_stop(responses, stop)),
            }
            return Ok(());
        }
        let answer = tokio::select! {
            biased;
            answer = self.exchange.answer(message) => answer,
            () = closed => return Err(Attachment::Ended),
        };
        match answer {
            Ok(answer) => {
                let reply = self.exchange.finish(answer);
                self.deliver(reply, responses).await
            }
            Err(stop) => Err(self.on_stop(responses, stop)),
        }
    }

    /// Sends a reply of a session that has no lease yet. The reply may grant the session a lease, or move its stream to
    /// a resumed session.
    async fn deliver(
        &mut self,
        reply: Reply<H::Response>,
        responses: &ResponseSender<H::Response>,
    ) -> Result<(), Attachment<H::Response>> {
        let Reply { response, memory, handover } = reply;
        let resumed = match handover {
            Some(StreamHandover::Lease(grant)) => {
                // After the loss of a stream, a client with a lease resends its unanswered requests. So no request may
                // be read before the previous request is answered.
                self.exchange.reads_ahead = false;
                self.lease = Some(ActiveLease { stored: ReplayBuffer::new(grant.max_unanswered), grant, sent: 0 });
                None
            }
            Some(StreamHandover::Resume(accepted)) => Some(accepted),
            None => None,
        };
        match responses.try_send(Ok(OutgoingResponse { response, memory })) {
            Ok(()) => {}
            Err(TrySendError::Closed(_)) => return Err(self.detach(None)),
            Err(TrySendError::Full(response)) => self.reserve_send(responses).await?.send(response),
        }
        let Some(accepted) = resumed else { return Ok(()) };
        self.exchange.ending = MOVED;
        // If the resumed session has ended meanwhile, the send fails, and the stream ends at once.
        let _ = accepted.stream.send(ResumingStream {
            requests: self.exchange.requests.detach(),
            responses: responses.clone(),
            drain: self.exchange.sessions.drain.clone(),
            runtime: Handle::current(),
        });
        Err(Attachment::Ended)
    }

    /// Waits until the stream can take another response.
    async fn reserve_send<'r>(
        &mut self,
        responses: &'r ResponseSender<H::Response>,
    ) -> Result<mpsc::Permit<'r, Result<OutgoingResponse<H::Response>, Status>>, Attachment<H::Response>> {
        let bearer = self.exchange.requests.bearer.clone();
        loop {
            let Self { exchange, lease } = self;
            let stop = tokio::select! {
                biased;
                () = exchange.sessions.drain.closed() => refused(Error::Draining),
                error = revoked(bearer.as_ref()) => refused(error),
                resume = resume_request(lease) => match self.accept_resume(resume) {
                    Some(resuming) => return Err(self.supersede(responses, resuming)),
                    None => continue,
                },
                permit = responses.reserve() => return permit.map_err(|_| self.detach(None)),
            };
            return Err(self.on_stop(responses, stop));
        }
    }

    /// Waits until another stream resumes the session or its lease expires.
    async fn run_detached(&mut self, mut resuming: Option<Resuming<H::Response>>) -> Attachment<H::Response> {
        let Self { exchange, lease } = self;
        let Some(lease) = lease else { return Attachment::Ended };
        let _counted = lease.grant.counters().detach();
        let expiry = Instant::now() + lease.grant.time();
        let bearer = exchange.requests.bearer.clone();
        loop {
            let error = tokio::select! {
                biased;
                () = exchange.sessions.drain.draining() => Some(Error::Draining),
                error = revoked(bearer.as_ref()) => Some(error.into()),
                arrived = arrival(&mut resuming) => {
                    resuming = None;
                    match arrived {
                        Ok(ResumingStream { requests, responses, drain, runtime }) => {
                            exchange.requests = requests;
                            exchange.sessions.drain = drain;
                            exchange.resumed += 1;
                            exchange.ending = GONE;
                            lease.grant.counters().add_resumed();
                            return Attachment::Resumed(runtime, responses);
                        }
                        Err(_) => continue, // the accepted stream was lost before it arrived
                    }
                }
                Some(resume) = lease.grant.resume_requests.recv() => {
                    resuming = lease.accept_resume(resume).or(resuming);
                    continue;
                }
                () = sleep_until(expiry) => None,
            };
            match error {
                Some(error) => exchange.end_by(&error),
                None => exchange.ending = LEASE_OVER,
            }
            return Attachment::Ended;
        }
    }

    fn accept_resume(&mut self, resume: ResumeRequest<H::Response>) -> Option<Resuming<H::Response>> {
        self.lease.as_mut().and_then(|lease| lease.accept_resume(resume))
    }

    /// Ends the current stream, because another stream resumes the session.
    fn supersede(
        &mut self,
        responses: &ResponseSender<H::Response>,
        resuming: Resuming<H::Response>,
    ) -> Attachment<H::Response> {
        end_stream(responses, status(&lease::Error::TakenUp));
        self.detach(Some(resuming))
    }

    /// Separates the session from its stream. A session without a lease ends.
    fn detach(&mut self, resuming: Option<Resuming<H::Response>>) -> Attachment<H::Response> {
        let Some(lease) = &mut self.lease else { return Attachment::Ended };
        drop(self.exchange.requests.detach());
        lease.stored.replies_mut().for_each(|reply| reply.outgoing = None);
        Attachment::Detached(resuming)
    }

    /// Handles a stream that cannot continue. A session with a lease ends only if the server itself stops the stream
    /// ([`StreamStop::Refused`]).
    fn on_stop(
        &mut self,
        responses: &ResponseSender<H::Response>,
        stop: StreamStop<H::Error>,
    ) -> Attachment<H::Response> {
        match (stop, self.lease.is_some()) {
            (StreamStop::Cancelled, _) => self.detach(None),
            (StreamStop::Broken(status), true) => {
                end_stream(responses, status);
                self.detach(None)
            }
            (stop, _) => {
                if let Some(status) = self.exchange.end(stop) {
                    end_stream(responses, status);
                }
                Attachment::Ended
            }
        }
    }

    /// Stores a reply for sending. If the stream is lost, the reply can be sent again on another stream. If the memory
    /// budget is exhausted, or the stored replies are longer than [`MAX_STORED_BYTES`], drops the older ones.
    fn store_reply(&mut self, answer: Result<Reply<H::Response>, H::Error>) {
        let Self { exchange, lease: Some(lease) } = self else { return };
        let stored = &mut lease.stored;
        let needs_memory =
            |kind| matches!(kind, ErrorKind::MemoryFull | ErrorKind::TokenQuota | ErrorKind::MoreThanTokenQuota);
        if answer.as_ref().is_err_and(|error| needs_memory(error.kind())) {
            stored.clear(); // all were sent, and the client's next attempt needs their memory
        }
        let Reply { response, memory: outgoing, .. } = exchange.finish(answer);
        let (budget, bytes) = (exchange.requests.budget().clone(), response.encoded_len() + REPLY_OVERHEAD_BYTES);
        let stored_bytes: usize =
            stored.replies().map(|reply| reply.memory.as_ref().map_or(0, MemoryReservation::bytes)).sum();
        let mut memory = budget.reserve(bytes);
        if memory.is_err() || stored_bytes + bytes > MAX_STORED_BYTES {
            stored.clear();
            memory = memory.or_else(|_| budget.reserve(bytes));
        }
        stored.push_reply(StoredReply { response, memory: memory.ok(), outgoing });
    }
}

impl<R: Clone> ActiveLease<R> {
    /// Returns the next reply that was not yet sent on the current stream.
    fn next(&mut self) -> Option<OutgoingResponse<R>> {
        self.sent += 1;
        let reply = self.stored.get_mut(self.sent)?;
        let (response, memory) = (reply.response.clone(), reply.outgoing.take());
        if reply.memory.is_none() {
            self.stored.clear();
        }
        Some(OutgoingResponse { response, memory })
    }

    /// Answers a stream's request to resume the session. Returns the channel through which the stream will arrive, or
    /// `None` if the request is refused or the stream is already lost.
    fn accept_resume(&mut self, ResumeRequest { last_reply, answer }: ResumeRequest<R>) -> Option<Resuming<R>> {
        if let Err(error) = self.stored.check(last_reply) {
            let _ = answer.send(Err(error)); // fails if the new stream has been lost, too
            return None;
        }
        let (arrival, resuming) = oneshot::channel();
        answer.send(Ok(ResumeAccepted { last_reply: self.stored.last(), stream: arrival })).ok()?;
        self.sent = last_reply;
        Some(resuming)
    }
}

/// Ends a stream with this status as soon as its channel has room.
fn end_stream<R: Send + 'static>(responses: &ResponseSender<R>, status: Status) {
    if let Err(TrySendError::Full(status)) = responses.try_send(Err(status)) {
        let responses = responses.clone();
        tokio::spawn(async move { responses.send(status).await });
    }
}

/// Waits for a stream's request to resume the session. Never resolves if there is no lease.
async fn resume_request<R>(lease: &mut Option<ActiveLease<R>>) -> ResumeRequest<R> {
    if let Some(lease) = lease
        && let Some(resume) = lease.grant.resume_requests.recv().await
    {
        return resume;
    }
    std::future::pending().await
}

/// Waits for the stream whose resume request was accepted. Never resolves if there is no such stream.
async fn arrival<R>(resuming: &mut Option<Resuming<R>>) -> Result<ResumingStream<R>, oneshot::error::RecvError> {
    match resuming {
        Some(resuming) => resuming.await,
        None => std::future::pending().await,
    }
}
