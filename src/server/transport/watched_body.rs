//! A response body that holds the memory reservation of each reply until the reply's bytes are sent, and closes the
//! connection of a client that does not read.

use super::budget::PendingReservations;
use crate::server::net::managed_io::ConnectionHandle;
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

/// The number of checks for unread replies in the time of one timeout.
const CHECKS_PER_TIMEOUT: u32 = 4;

/// The maximum times for which a stream's client may leave replies unread.
#[derive(Debug, Clone, Copy)]
pub struct ReadTimeouts {
    /// The limit for the first reply.
    pub first: Duration,
    /// The limit for each later reply; `None` for no limit.
    pub rest: Option<Duration>,
}

/// The response body of a stream. The connection ends if the client does not read the body in time.
pub struct WatchedBody {
    body: Body,
    pending_reservations: PendingReservations,
    progress: Arc<ReadProgress>,
}

/// The client's progress in reading replies.
struct ReadProgress {
    state: Mutex<ProgressState>,
    /// The task that checks the timeouts. The task holds a handle to the connection, so the task is aborted when this
    /// value is dropped.
    watch: OnceLock<AbortHandle>,
}

struct ProgressState {
    /// The number of unread replies that hold reservations.
    unread: usize,
    unread_since: Instant,
    /// The time since which a reply waits for the client's flow-control window. Meanwhile the session reads no
    /// requests, so its own timeouts cannot end it.
    blocked_since: Option<Instant>,
    /// Whether the client has read no reply yet.
    is_first: bool,
}

impl ProgressState {
    fn new() -> Self {
        Self { unread: 0, unread_since: Instant::now(), blocked_since: None, is_first: true }
    }

    /// Returns the timeout that the client has exceeded, if any.
    fn exceeded(&self, timeouts: ReadTimeouts) -> Option<Duration> {
        let blocked = self.blocked_since.map_or(Duration::ZERO, |since| since.elapsed());
        let unread = if self.unread == 0 { Duration::ZERO } else { self.unread_since.elapsed() };
        let first = Some(timeouts.first).filter(|&limit| self.is_first && blocked > limit);
        first.or(timeouts.rest.filter(|&limit| blocked.max(unread) > limit))
    }
}

impl ReadProgress {
    fn state(&self) -> MutexGuard<'_, ProgressState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the number of unread replies. Restarts their timeout if the client has read a reply, or if no reply was
    /// unread before.
    fn change(&self, change: impl FnOnce(usize) -> usize) {
        let mut state = self.state();
        let (before, after) = (state.unread, change(state.unread));
        state.unread = after;
        if before == 0 || after < before {
            state.unread_since = Instant::now();
        }
    }

    /// Records that the transport asks for more data, so the previous reply no longer waits for the client's window.
    fn on_poll(&self) {
        let mut state = self.state();
        if state.blocked_since.take().is_some() {
            state.is_first = false;
        }
    }

    /// Records that the transport has taken data from the body. The data may have to wait for the client's window.
    fn on_frame(&self) {
        self.state().blocked_since = Some(Instant::now());
    }
}

impl Drop for ReadProgress {
    fn drop(&mut self) {
        self.watch.get().into_iter().for_each(AbortHandle::abort);
    }
}

/// A guard that counts a reply as unread until it is dropped.
struct UnreadGuard(Arc<ReadProgress>);

impl UnreadGuard {
    fn new(progress: &Arc<ReadProgress>) -> Self {
        progress.change(|replies| replies + 1);
        Self(Arc::clone(progress))
    }
}

impl Drop for UnreadGuard {
    fn drop(&mut self) {
        self.0.change(|replies| replies - 1);
    }
}

impl WatchedBody {
    /// Wraps a response body. Attaches the reservations in `pending_reservations` to its bytes, and closes `connection`
    /// if the client leaves replies unread for longer than `timeouts`.
    pub fn new(
        body: Body,
        pending_reservations: PendingReservations,
        connection: Option<ConnectionHandle>,
        timeouts: Option<ReadTimeouts>,
    ) -> Self {
        let progress = Arc::new(ReadProgress { state: Mutex::new(ProgressState::new()), watch: OnceLock::new() });
        if let (Some(connection), Some(timeouts)) = (connection, timeouts) {
            let watch = tokio::spawn(watch(Arc::downgrade(&progress), connection, timeouts));
            progress.watch.get_or_init(|| watch.abort_handle());
        }
        Self { body, pending_reservations, progress }
    }
}

/// Closes the connection when its client has exceeded a read timeout.
async fn watch(progress: Weak<ReadProgress>, connection: ConnectionHandle, timeouts: ReadTimeouts) {
    let mut limit = Some(timeouts.rest.map_or(timeouts.first, |rest| rest.min(timeouts.first)));
    while let Some(timeout) = limit {
        sleep(timeout / CHECKS_PER_TIMEOUT).await;
        let Some(progress) = progress.upgrade() else { return };
        let state = progress.state();
        if let Some(exceeded) = state.exceeded(timeouts) {
            let seconds = exceeded.as_secs();
            tracing::warn!(peer = ?connection.peer, seconds, "ended a connection that did not read its replies");
            return connection.close();
        }
        if !state.is_first {
            limit = timeouts.rest;
        }
    }
}

impl HttpBody for WatchedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Self { body, pending_reservations, progress } = &mut *self;
        progress.on_poll();
        let polled = Pin::new(body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && frame.data_ref().is_some_and(|bytes| !bytes.is_empty())
        {
            progress.on_frame();
        }
        polled.map_ok(|frame| frame.map_data(|bytes| pending_reservations.attach(bytes, || UnreadGuard::new(progress))))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
