//! The transport that the streams of both protocols share: one response for each request, in order, until the client's
//! end or the server's.

use super::{
    drain::{Drain, Phase},
    status::Refusal,
};
use futures_util::{Stream, stream};
use std::{
    future::Future,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};
use tonic::{Status, Streaming};

/// Responses as they come, or the status that ends the stream.
pub type Responses<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// The server's part of a conversation. Dropping it frees what it holds.
pub trait Dialogue: Send + 'static {
    /// What the client sends.
    type Request: Send + 'static;
    /// What it gets.
    type Response: Send + 'static;

    /// Whether it holds something that a shutdown should wait for.
    fn is_open(&self) -> bool;

    /// Answers a request.
    fn answer(&mut self, request: Self::Request) -> impl Future<Output = Self::Response> + Send;
}

/// What all sessions of the server are subject to: their number, how long they may be silent, and the shutdown.
#[derive(Clone)]
pub struct Sessions {
    count: Arc<AtomicUsize>,
    limit: usize,
    idle: Option<Duration>,
    drain: Drain,
}

impl Sessions {
    /// At most `limit` sessions at a time, each of which may be idle for `idle`, or for ever.
    pub fn new(limit: usize, idle: Option<Duration>, drain: Drain) -> Self {
        Self { count: Arc::default(), limit, idle, drain }
    }

    /// How far the shutdown is.
    pub fn phase(&self) -> Phase {
        self.drain.phase()
    }

    /// Begins a session: the dialogue answers what the stream of requests brings.
    ///
    /// # Errors
    /// If the server is shutting down or has no room for another session.
    pub fn begin<D: Dialogue>(
        &self,
        requests: Streaming<D::Request>,
        dialogue: D,
    ) -> Result<Responses<D::Response>, Status> {
        if self.phase() != Phase::Running {
            return Err(Refusal::Draining.into());
        }
        let Some(ticket) = Ticket::take(&self.count, self.limit) else {
            return Err(Refusal::TooManySessions { limit: self.limit }.into());
        };
        let drain = self.drain.enter();
        let conversation = Conversation { requests, dialogue, idle: self.idle, drain, _ticket: ticket };
        // Polled by the connection: when the client is gone the stream is dropped, and what the dialogue holds with it.
        let responses = stream::unfold(Some(conversation), |conversation| async {
            let mut conversation = conversation?;
            match conversation.next().await? {
                Ok(response) => Some((Ok(response), Some(conversation))),
                Err(status) => Some((Err(status), None)),
            }
        });
        Ok(Box::pin(responses))
    }
}

/// A dialogue and its transport.
struct Conversation<D: Dialogue> {
    requests: Streaming<D::Request>,
    dialogue: D,
    idle: Option<Duration>,
    drain: Drain,
    _ticket: Ticket,
}

impl<D: Dialogue> Conversation<D> {
    /// The next response; an error ends the stream, and so does the client's end.
    async fn next(&mut self) -> Option<Result<D::Response, Status>> {
        let request = tokio::select! {
            biased; // the end comes first: a client that never pauses must not outlast it
            () = self.drain.closed() => return Some(Err(Refusal::Draining.into())),
            request = self.requests.message() => match request {
                Ok(request) => request?,
                Err(status) => return Some(Err(status)),
            },
            () = idle(self.idle) => {
                let seconds = self.idle.map_or(0, |idle| idle.as_secs());
                return Some(Err(Refusal::Idle { seconds }.into()));
            }
        };
        if self.drain.phase() != Phase::Running && !self.dialogue.is_open() {
            return Some(Err(Refusal::Draining.into()));
        }
        Some(Ok(self.dialogue.answer(request).await))
    }
}

async fn idle(limit: Option<Duration>) {
    match limit {
        Some(limit) => tokio::time::sleep(limit).await,
        None => std::future::pending().await,
    }
}

/// A place among the sessions.
struct Ticket(Arc<AtomicUsize>);

impl Ticket {
    fn take(sessions: &Arc<AtomicUsize>, limit: usize) -> Option<Self> {
        let fits = |n: usize| (n < limit).then_some(n + 1);
        sessions.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).ok()?;
        Some(Self(Arc::clone(sessions)))
    }
}

impl Drop for Ticket {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}
