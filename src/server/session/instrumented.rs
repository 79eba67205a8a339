//! Spans and counts of requests: a layer around the dialogues of both protocols.

use super::handler::{Dialogue, Turn};
use crate::{
    pool::Follower,
    server::{
        limits::Allowance,
        net::access_log::About,
        transport::{budget::Outbox, precheck::Field},
    },
};
use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};
use tracing::Instrument;

/// A dialogue that tells its requests and responses apart.
pub trait Observed: Dialogue {
    /// What there can be asked.
    const KINDS: &'static [&'static str];

    /// Which of the kinds it is.
    fn kind(request: &Self::Request) -> &'static str;
}

/// Requests of one kind since the server began.
#[derive(Default)]
pub struct Count {
    /// All of them.
    pub answered: AtomicU64,
    /// Those that were answered by a refusal.
    pub refused: AtomicU64,
}

/// The requests of a protocol, by kind.
pub struct Counts(Vec<(&'static str, Count)>);

impl Counts {
    /// None yet.
    pub fn of<D: Observed>() -> Arc<Self> {
        Arc::new(Self(D::KINDS.iter().map(|kind| (*kind, Count::default())).collect()))
    }

    /// Every kind with its count.
    pub fn iter(&self) -> impl Iterator<Item = &(&'static str, Count)> {
        self.0.iter()
    }
}

impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, (kind, count)) in self.iter().enumerate() {
            let [answered, refused] = [&count.answered, &count.refused].map(|count| count.load(Ordering::Relaxed));
            write!(f, "{}{kind} {answered} ({refused} refused)", if i > 0 { ", " } else { "" })?;
        }
        Ok(())
    }
}

/// A dialogue whose requests are counted, each in a span of its own.
pub struct Counted<D> {
    dialogue: D,
    counts: Arc<Counts>,
}

impl<D: Observed> Counted<D> {
    /// Puts the layer around a dialogue.
    pub fn new(dialogue: D, counts: &Arc<Counts>) -> Self {
        Self { dialogue, counts: Arc::clone(counts) }
    }
}

impl<D: Observed> Counted<D> {
    fn count(&self, kind: &str, error: Option<&D::Error>) {
        if let Some(error) = error {
            tracing::debug!(refusal = error.to_string(), "refused");
        }
        if let Some((_, count)) = self.counts.iter().find(|(known, _)| *known == kind) {
            count.answered.fetch_add(1, Ordering::Relaxed);
            count.refused.fetch_add(error.is_some().into(), Ordering::Relaxed);
        }
    }
}

impl<D: Observed> Dialogue for Counted<D> {
    type Request = D::Request;
    type Response = D::Response;
    type Error = D::Error;
    const FIELDS: &'static [Field] = D::FIELDS;
    const TAKES_UP: bool = D::TAKES_UP;
    const PROTOCOL: &'static str = D::PROTOCOL;

    fn allowance(&self) -> Allowance {
        self.dialogue.allowance()
    }

    fn is_open(&self) -> bool {
        self.dialogue.is_open()
    }

    fn about(&self) -> About {
        self.dialogue.about()
    }

    async fn answer(&mut self, request: Self::Request) -> Result<Self::Response, Self::Error> {
        let kind = D::kind(&request);
        let span = tracing::debug_span!("request", kind);
        let response = self.dialogue.answer(request).instrument(span.clone()).await;
        span.in_scope(|| self.count(kind, response.as_ref().err()));
        response
    }

    fn follower(&self, request: &Self::Request) -> Option<Follower> {
        self.dialogue.follower(request)
    }

    fn follow(follower: &Follower, request: Self::Request) {
        D::follow(follower, request);
    }

    fn undecoded(&self, error: &Self::Error) {
        self.count("unknown", Some(error));
    }

    fn takes_up(request: &Self::Request) -> bool {
        D::takes_up(request)
    }

    fn turn(&mut self) -> Option<Turn<Self::Response>> {
        self.dialogue.turn()
    }

    fn attach(&mut self, outbox: Outbox) {
        self.dialogue.attach(outbox);
    }

    fn refusal(error: Self::Error) -> Self::Response {
        D::refusal(error)
    }
}
