//! The trait of handlers, which answer the requests of a session. It is the same for both protocols.

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

/// The effect of a response on the stream that it is sent in.
pub enum StreamHandover<R> {
    /// The session has a lease from now on, and outlives the stream.
    Lease(LeaseGuard<R>),
    /// The stream continues with the session that it resumes.
    Resume(ResumeAccepted<R>),
}

/// The answer to a request.
pub struct Reply<R> {
    /// The response.
    pub response: R,
    /// The reservation for the response until it is sent; `None` if the session's own reservation covers it.
    pub memory: Option<MemoryReservation>,
    /// The effect of the response on its stream, if it has one.
    pub handover: Option<StreamHandover<R>>,
}

impl<R> Reply<R> {
    /// A reply without a reservation and without an effect on its stream.
    pub fn new(response: R) -> Self {
        Self { response, memory: None, handover: None }
    }
}

/// The state of one session, in one protocol. Dropping it frees its resources.
pub trait SessionHandler: Send + 'static {
    /// A message of the client.
    type Request: prost::Message + Default + 'static;
    /// A message of the server.
    type Response: prost::Message + Clone + 'static;
    /// Why a request is refused, by the handler or before it.
    type Error: RequestError + From<Error> + Send;
    /// The fields of a request whose entries are counted before it is decoded.
    const FIELDS: &'static [Field];
    /// The protocol's name in logs and metrics.
    const PROTOCOL: &'static str;
    /// The kinds of requests in logs and metrics. The last one is for requests that cannot be decoded.
    const KINDS: &'static [&'static str];
    /// Whether a request resumes another session; `None` in a protocol without leases.
    const RESUMES: Option<fn(&Self::Request) -> bool>;

    /// The kind of a request, one of [`KINDS`](Self::KINDS).
    fn kind(request: &Self::Request) -> &'static str;

    /// The size limits of the next request.
    fn request_limits(&self) -> RequestLimits;

    /// Whether a shutdown should wait for the session.
    fn is_open(&self) -> bool;

    /// The environment of the session, and its steps so far.
    fn stats(&self) -> SessionStats;

    /// The price of a request besides that of its steps, in steps of an environment. A token's rate counts both.
    fn price(&self, request: &Self::Request) -> u64;

    /// Frees the session's resources. Resolves when they are free, so that another session like it has room.
    fn close(&mut self) -> impl Future<Output = ()> + Send;

    /// Answers a request.
    ///
    /// # Errors
    /// If the request is refused. The session stays open.
    fn answer(
        &mut self,
        request: Self::Request,
    ) -> impl Future<Output = Result<Reply<Self::Response>, Self::Error>> + Send;

    /// Returns a function that offers the next request to the pool while `request` runs, or `None` if the next request
    /// must wait. If the caller offers a request, it must answer that request next.
    fn pipeline(&self, request: &Self::Request) -> Option<impl FnOnce(Self::Request) + Send + use<Self>>;

    /// The response to a request that is refused.
    fn error_response(error: Self::Error) -> Self::Response;
}
