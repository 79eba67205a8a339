//! The gate before the services.

use super::Tokens;
use crate::server::{net::peers::Connection, refusals::Refusals};
use std::{
    convert::Infallible,
    future::{Future, ready},
    pin::Pin,
    task::{Context, Poll},
};
use tonic::{
    Status,
    body::Body,
    codegen::{Service, http},
    server::NamedService,
};

/// A service that answers whoever shows a token, if there are any to be shown.
#[derive(Clone)]
pub struct Gated<S> {
    service: S,
    tokens: Option<Tokens>,
    refusals: Refusals,
}

impl<S> Gated<S> {
    /// Asks for one of these, or for none, and counts whom it refuses.
    pub fn new(service: S, tokens: Option<Tokens>, refusals: Refusals) -> Self {
        Self { service, tokens, refusals }
    }
}

impl<S: NamedService> NamedService for Gated<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for Gated<S>
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
        match self.tokens.as_ref().map(|tokens| tokens.admit(&request)).transpose() {
            Ok(bearer) => {
                if let Some(bearer) = bearer.flatten() {
                    request.extensions_mut().insert(bearer);
                }
                Box::pin(self.service.call(request))
            }
            Err(refusal) => {
                let peer = request.extensions().get::<Connection>().map(|connection| connection.peer);
                tracing::debug!(?peer, path = request.uri().path(), %refusal, "refused a call");
                self.refusals.count(&refusal, None);
                Box::pin(ready(Ok(Status::from(refusal).into_http())))
            }
        }
    }
}
