//! The tower layer that authenticates gRPC calls.

use super::Tokens;
use crate::server::{
    error::{ErrorCounters, RequestError, status},
    net::managed_io::ConnectionHandle,
};
use std::{
    convert::Infallible,
    future::{Future, ready},
    pin::Pin,
    task::{Context, Poll},
};
use tonic::{
    body::Body,
    codegen::{Service, http},
    server::NamedService,
};
use tower::Layer;

/// A tower service that passes a call over TCP to the wrapped service only if the call has a valid token. Calls over a
/// Unix socket need no token. If the server does not use tokens, all calls pass.
#[derive(Clone)]
pub struct AuthService<S> {
    service: S,
    tokens: Option<Tokens>,
    counters: ErrorCounters,
}

/// The tower layer that wraps a service in [`AuthService`].
#[derive(Clone)]
pub struct AuthLayer {
    tokens: Option<Tokens>,
    counters: ErrorCounters,
}

impl AuthLayer {
    /// Makes a layer that requires one of these tokens; `None` lets all calls pass. Rejected calls are counted in
    /// `counters`.
    pub fn new(tokens: Option<Tokens>, counters: ErrorCounters) -> Self {
        Self { tokens, counters }
    }
}

impl<S> Layer<S> for AuthLayer {
    type Service = AuthService<S>;

    fn layer(&self, service: S) -> Self::Service {
        AuthService { service, tokens: self.tokens.clone(), counters: self.counters.clone() }
    }
}

impl<S: NamedService> NamedService for AuthService<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for AuthService<S>
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
        match self.tokens.as_ref().map(|tokens| tokens.authenticate(&request)).transpose() {
            Ok(bearer) => {
                if let Some(bearer) = bearer.flatten() {
                    request.extensions_mut().insert(bearer);
                }
                Box::pin(self.service.call(request))
            }
            Err(error) => {
                let peer = request.extensions().get::<ConnectionHandle>().map(|connection| connection.peer);
                tracing::debug!(?peer, path = request.uri().path(), refusal = %error, "refused a call");
                self.counters.count(error.kind());
                Box::pin(ready(Ok(status(&error).into_http())))
            }
        }
    }
}
