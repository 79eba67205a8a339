//! Replies on their way to the wire: their shares of the budget go with their bytes, and a client that does not read
//! loses its connection.

use super::budget::PendingReservations;
use crate::server::net::managed_io::Connection;
use bytes::Bytes;
use http_body::{Body as HttpBody, Frame, SizeHint};
use std::{
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak},
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    task::AbortHandle,
    time::{Instant, sleep},
};
use tonic::{Status, body::Body};

/// The number of checks of an unread stream within its timeout.
const CHECKS_PER_TIMEOUT: u32 = 4;

/// The time that a stream's client may leave its replies unread.
#[derive(Debug, Clone, Copy)]
pub struct ReadTimeouts {
    /// The first reply.
    pub first: Duration,
    /// Any later reply; `None` for no limit.
    pub rest: Option<Duration>,
}

/// A response's body.
pub struct WatchedBody {
    body: Body,
    outbox: PendingReservations,
    waiting: Arc<ReadProgress>,
}

/// The progress of the client with the replies.
struct ReadProgress {
    state: Mutex<State>,
    /// The task that checks the timeouts. It is aborted with the body, because it holds on to the connection.
    watch: OnceLock<AbortHandle>,
}

struct State {
    /// Number of unread replies that hold reservations.
    unread: usize,
    since: Instant,
    /// The time since which a reply waits for the flow control of the client. The session is not asked for more meanwhile,
    /// so none of its own limits would end it.
    held: Option<Instant>,
    /// No reply has been taken yet.
    is_first: bool,
}

impl State {
    fn new() -> Self {
        Self { unread: 0, since: Instant::now(), held: None, is_first: true }
    }

    /// The timeout that the client has exceeded, if any.
    fn passed(&self, patience: ReadTimeouts) -> Option<Duration> {
        let held = self.held.map_or(Duration::ZERO, |since| since.elapsed());
        let unread = if self.unread == 0 { Duration::ZERO } else { self.since.elapsed() };
        let first = Some(patience.first).filter(|&limit| self.is_first && held > limit);
        first.or(patience.rest.filter(|&limit| held.max(unread) > limit))
    }
}

impl ReadProgress {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the number of unread replies.
    fn change(&self, change: impl FnOnce(usize) -> usize) {
        let mut state = self.state();
        let (before, after) = (state.unread, change(state.unread));
        state.unread = after;
        if before == 0 || after < before {
            state.since = Instant::now();
        }
    }

    /// Notes that the transport asks for a reply: the one before is on its way.
    fn asked(&self) {
        let mut state = self.state();
        if state.held.take().is_some() {
            state.is_first = false;
        }
    }

    /// Notes that the transport has a reply.
    fn hold(&self) {
        self.state().held = Some(Instant::now());
    }
}

impl Drop for ReadProgress {
    fn drop(&mut self) {
        self.watch.get().into_iter().for_each(AbortHandle::abort);
    }
}

/// An unread reply, until it is dropped.
struct UnreadGuard(Arc<ReadProgress>);

impl UnreadGuard {
    fn new(waiting: &Arc<ReadProgress>) -> Self {
        waiting.change(|replies| replies + 1);
        Self(Arc::clone(waiting))
    }
}

impl Drop for UnreadGuard {
    fn drop(&mut self) {
        self.0.change(|replies| replies - 1);
    }
}

impl WatchedBody {
    /// Wraps a response body and attaches queued reservations to its bytes. Closes the connection when the client leaves data
    /// unread longer than `patience`.
    pub fn new(
        body: Body,
        outbox: PendingReservations,
        connection: Option<Connection>,
        patience: Option<ReadTimeouts>,
    ) -> Self {
        let waiting = Arc::new(ReadProgress { state: Mutex::new(State::new()), watch: OnceLock::new() });
        if let (Some(connection), Some(patience)) = (connection, patience) {
            let watch = tokio::spawn(watch(Arc::downgrade(&waiting), connection, patience));
            waiting.watch.get_or_init(|| watch.abort_handle());
        }
        Self { body, outbox, waiting }
    }
}

/// Ends the connection when its client has read nothing for too long.
async fn watch(waiting: Weak<ReadProgress>, connection: Connection, patience: ReadTimeouts) {
    let mut limit = Some(patience.rest.map_or(patience.first, |rest| rest.min(patience.first)));
    while let Some(looked_after) = limit {
        sleep(looked_after / CHECKS_PER_TIMEOUT).await;
        let Some(waiting) = waiting.upgrade() else { return };
        let state = waiting.state();
        if let Some(passed) = state.passed(patience) {
            let seconds = passed.as_secs();
            tracing::warn!(peer = ?connection.peer, seconds, "ended a connection that did not read its replies");
            return connection.end();
        }
        if !state.is_first {
            limit = patience.rest;
        }
    }
}

impl HttpBody for WatchedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Self { body, outbox, waiting } = &mut *self;
        waiting.asked();
        let polled = Pin::new(body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && frame.data_ref().is_some_and(|bytes| !bytes.is_empty())
        {
            waiting.hold();
        }
        polled.map_ok(|frame| frame.map_data(|bytes| outbox.send(bytes, || UnreadGuard::new(waiting))))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
