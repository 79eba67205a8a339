//! The trait by which a protocol answers the requests of a session.

use super::{
    Error,
    lease::{LeaseGuard, ResumeAccepted},
};
use crate::server::{
    error::RequestError,
    limits::RequestLimits,
    net::access_log::SessionStats,
    transport::{budget::MemoryReservation, precheck::Field},
};
use std::future::Future;

/// The effect of a response on the stream on which it is sent.
pub enum StreamHandover<R> {
    /// Grants the session a lease, so the session may outlive the stream.
    Lease(LeaseGuard<R>),
    /// Moves the stream to the session that it resumes.
    Resume(ResumeAccepted<R>),
}

/// The answer to a request.
pub struct Reply<R> {
    /// The response.
    pub response: R,
    /// The memory reservation for the response, held until it is sent. `None` if the response needs no reservation of
    /// its own, e.g. because the session reserved memory for it when the session was opened.
    pub memory: Option<MemoryReservation>,
    /// The effect of the response on its stream, if any.
    pub handover: Option<StreamHandover<R>>,
}

impl<R> Reply<R> {
    /// Makes a reply without a reservation and without an effect on its stream.
    pub fn new(response: R) -> Self {
        Self { response, memory: None, handover: None }
    }
}

/// The handler of one session's requests, in one protocol. Dropping it frees the session's resources.
pub trait SessionHandler: Send + 'static {
    /// The type of the client's messages.
    type Request: prost::Message + Default + 'static;
    /// The type of the server's messages.
    type Response: prost::Message + Clone + 'static;
    /// The error with which the handler refuses a request, or with which the session layer refuses it before the
    /// handler gets it.
    type Error: RequestError + From<Error> + Send;
    /// The fields of a request whose entries are counted, and limited, before the request is decoded.
    const FIELDS: &'static [Field];
    /// The protocol's name in logs and metrics.
    const PROTOCOL: &'static str;
    /// The kinds of requests in logs and metrics. The last one is for requests that cannot be decoded.
    const KINDS: &'static [&'static str];
    /// The function that tells whether a request resumes another session. `None` in a protocol without leases.
    const RESUMES: Option<fn(&Self::Request) -> bool>;

    /// The kind of a request, one of [`KINDS`](Self::KINDS).
    fn kind(request: &Self::Request) -> &'static str;

    /// The size limits of the next request.
    fn request_limits(&self) -> RequestLimits;

    /// Whether the client has opened the session. Only an open session may continue during a shutdown.
    fn is_open(&self) -> bool;

    /// Returns the session's environment, its number of environments, and its steps so far.
    fn stats(&self) -> SessionStats;

    /// The price of a request, in steps of one environment. The steps that the request runs are charged in addition. A
    /// token's rate limits the sum of price and steps.
    fn price(&self, request: &Self::Request) -> u64;

    /// Frees the session's resources. Resolves when they are free for other sessions.
    fn close(&mut self) -> impl Future<Output = ()> + Send;

    /// Answers a request.
    ///
    /// # Errors
    /// The reason, if the request is refused. The session stays open.
    fn answer(
        &mut self,
        request: Self::Request,
    ) -> impl Future<Output = Result<Reply<Self::Response>, Self::Error>> + Send;

    /// Whether [`draw_ahead`](Self::draw_ahead) can make the next step faster.
    fn draws_ahead(&self) -> bool {
        false
    }

    /// Draws random numbers of the next step while the session waits for its request.
    fn draw_ahead(&mut self) {}

    /// Returns a function that offers the next request to the pool while `request` runs, or `None` if the next request
    /// must wait. A request that was passed to this function must be the next one that the handler answers.
    fn pipeline(&self, request: &Self::Request) -> Option<impl FnOnce(Self::Request) + Send + use<Self>>;

    /// Makes the response to a refused request.
    fn error_response(error: Self::Error) -> Self::Response;
}
