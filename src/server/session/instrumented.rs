//! Counts the requests of each kind, and traces each request in a span.

use super::handler::{Reply, SessionHandler};
use crate::server::error::RequestError;
use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};
use tracing::Instrument;

/// The number of requests of one kind since the server started.
#[derive(Default)]
pub struct RequestCount {
    /// The number of answered requests, including refused requests.
    pub answered: AtomicU64,
    /// The number of refused requests.
    pub refused: AtomicU64,
}

/// The counters of a protocol's requests, by kind.
pub struct RequestCounters(Vec<(&'static str, RequestCount)>);

impl RequestCounters {
    /// Makes counters, all 0, for the kinds of requests that the handler `H` answers.
    pub fn new<H: SessionHandler>() -> Arc<Self> {
        Arc::new(Self(H::KINDS.iter().map(|kind| (*kind, RequestCount::default())).collect()))
    }

    /// Returns every kind of request with its counts.
    pub fn iter(&self) -> impl Iterator<Item = &(&'static str, RequestCount)> {
        self.0.iter()
    }

    /// Has `handler` answer a request in a tracing span, and counts the request.
    pub(super) async fn answer<H: SessionHandler>(
        &self,
        handler: &mut H,
        request: H::Request,
    ) -> Result<Reply<H::Response>, H::Error> {
        let kind = H::kind(&request);
        let span = tracing::debug_span!("request", kind);
        let reply = handler.answer(request).instrument(span.clone()).await;
        span.in_scope(|| self.count(kind, reply.as_ref().err()));
        reply
    }

    /// Counts a request that was refused before it reached the handler.
    pub(super) fn count_undecoded(&self, error: &impl RequestError) {
        self.count("unknown", Some(error));
    }

    fn count(&self, kind: &str, error: Option<&impl RequestError>) {
        if let Some(error) = error {
            tracing::debug!(refusal = error.to_string(), "refused");
        }
        if let Some((_, count)) = self.iter().find(|(known, _)| *known == kind) {
            count.answered.fetch_add(1, Ordering::Relaxed);
            count.refused.fetch_add(error.is_some().into(), Ordering::Relaxed);
        }
    }
}

impl fmt::Display for RequestCounters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, (kind, count)) in self.iter().enumerate() {
            let [answered, refused] = [&count.answered, &count.refused].map(|count| count.load(Ordering::Relaxed));
            write!(f, "{}{kind} {answered} ({refused} refused)", if i > 0 { ", " } else { "" })?;
        }
        Ok(())
    }
}
