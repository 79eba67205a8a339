//! Withholds the request bodies of sessions from tonic, which would decode their messages itself. [`MessageReader`]
//! reads these bodies instead.

use super::{
    budget::PendingReservations,
    compression::Compression,
    message_reader::{MessageReader, StreamLimits},
    watched_body::{ReadTimeouts, WatchedBody},
};
use crate::server::{auth::Bearer, net::managed_io::ConnectionHandle};
use std::{
    convert::Infallible,
    future::Future,
    pin::Pin,
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll},
};
use tonic::{
    Status,
    body::Body,
    codegen::{Service, http},
    server::NamedService,
};
use tower::Layer;

/// A tower service that withholds the request bodies of calls to the method `path` from the wrapped tonic service.
#[derive(Clone)]
pub struct RawBodyService<S> {
    service: S,
    path: &'static str,
    stream_limits: StreamLimits,
}

/// The tower layer that wraps a service in [`RawBodyService`].
#[derive(Clone)]
pub struct RawBodyLayer {
    path: &'static str,
    stream_limits: StreamLimits,
}

impl RawBodyLayer {
    /// Makes a layer for the method with this path. Its streams get the limits `stream_limits`.
    pub fn new(path: &'static str, stream_limits: StreamLimits) -> Self {
        Self { path, stream_limits }
    }
}

impl<S> Layer<S> for RawBodyLayer {
    type Service = RawBodyService<S>;

    fn layer(&self, service: S) -> Self::Service {
        RawBodyService::new(service, self.path, self.stream_limits.clone())
    }
}

impl<S> RawBodyService<S> {
    /// Wraps `service`. Streams of the method with this path get the limits `stream_limits`.
    pub fn new(service: S, path: &'static str, stream_limits: StreamLimits) -> Self {
        Self { service, path, stream_limits }
    }
}

impl<S: NamedService> NamedService for RawBodyService<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for RawBodyService<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Self::Response, Infallible>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<Body>) -> Self::Future {
        let pending_reservations = PendingReservations::default();
        let connection = request.extensions().get::<ConnectionHandle>().cloned();
        let is_stream = request.uri().path() == self.path;
        // Unary calls have one small reply, which needs no timeout.
        let timeouts =
            is_stream.then_some(ReadTimeouts { first: self.stream_limits.handshake, rest: self.stream_limits.limit });
        if is_stream {
            let bearer = request.extensions_mut().remove::<Bearer>();
            let stream_limits =
                StreamLimits { budget: self.stream_limits.budget.for_token(bearer.clone()), ..self.stream_limits };
            let body = std::mem::take(request.body_mut());
            let compression = Compression::from_headers(request.headers());
            let reader = MessageReader::new(
                body,
                compression,
                stream_limits,
                connection.clone(),
                bearer,
                pending_reservations.clone(),
            );
            request.extensions_mut().insert(RawBody(Arc::new(Mutex::new(Some(reader)))));
        }
        let response = self.service.call(request);
        Box::pin(async move {
            Ok(response
                .await?
                .map(|body| Body::new(WatchedBody::new(body, pending_reservations, connection, timeouts))))
        })
    }
}

/// A request extension that carries the reader of the raw body. Extensions must be `Clone`, hence the shared cell.
#[derive(Clone)]
struct RawBody(Arc<Mutex<Option<MessageReader>>>);

/// Takes the message reader out of a request whose body was withheld from tonic.
///
/// # Errors
/// If the body was not withheld, which is a defect.
pub fn messages<T>(request: &mut tonic::Request<T>) -> Result<MessageReader, Status> {
    let raw_body = request.extensions_mut().remove::<RawBody>();
    let reader = raw_body.and_then(|raw_body| raw_body.0.lock().unwrap_or_else(PoisonError::into_inner).take());
    reader.ok_or_else(|| Status::internal("the request's body is not there: a defect of the server"))
}
