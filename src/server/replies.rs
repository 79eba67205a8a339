//! Replies on their way to the wire: their shares of the budget go with their bytes, and a client that holds shares and
//! does not read loses its connection.

use super::{budget::Outbox, peers::Connection};
use bytes::Bytes;
use http_body::{Body as HttpBody, Frame, SizeHint};
use std::{
    pin::Pin,
    sync::{Arc, Mutex, OnceLock, PoisonError, Weak},
    task::{Context, Poll},
    time::Duration,
};
use tokio::{
    task::AbortHandle,
    time::{Instant, sleep},
};
use tonic::{Status, body::Body};

/// How often a stalled stream is looked after within its time.
const LOOKS: u32 = 4;

/// A response's body.
pub struct Replies {
    body: Body,
    outbox: Outbox,
    waiting: Arc<Waiting>,
}

/// The replies with shares that wait for the client to read.
struct Waiting {
    /// How many they are, and since when the client has read none of them to its end.
    state: Mutex<(usize, Instant)>,
    /// Who looks after them, up to their end: as long as that waits it holds what it needs of the connection.
    watch: OnceLock<AbortHandle>,
}

impl Waiting {
    /// One more, or one less.
    fn change(&self, change: impl FnOnce(usize) -> usize) {
        let mut waiting = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let (before, after) = (waiting.0, change(waiting.0));
        waiting.0 = after;
        if before == 0 || after < before {
            waiting.1 = Instant::now();
        }
    }

    fn elapsed(&self) -> Duration {
        let (replies, since) = *self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if replies == 0 { Duration::ZERO } else { since.elapsed() }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.watch.get().into_iter().for_each(AbortHandle::abort);
    }
}

/// A reply that waits, until it is dropped.
struct Unread(Arc<Waiting>);

impl Unread {
    fn new(waiting: &Arc<Waiting>) -> Self {
        waiting.change(|replies| replies + 1);
        Self(Arc::clone(waiting))
    }
}

impl Drop for Unread {
    fn drop(&mut self) {
        self.0.change(|replies| replies - 1);
    }
}

impl Replies {
    /// A body whose replies' shares are in the outbox. If its client does not read such a reply within `limit`, its
    /// connection ends.
    pub fn new(body: Body, outbox: Outbox, connection: Option<Connection>, limit: Option<Duration>) -> Self {
        // The watch begins when there is something to look after: it ends where there is nothing.
        let waiting = Arc::new(Waiting { state: Mutex::new((0, Instant::now())), watch: OnceLock::new() });
        if let (Some(connection), Some(limit)) = (connection, limit) {
            let watch = tokio::spawn(watch(Arc::downgrade(&waiting), connection, limit));
            waiting.watch.get_or_init(|| watch.abort_handle());
        }
        Self { body, outbox, waiting }
    }
}

/// Ends the connection when its client has read nothing for that long.
async fn watch(waiting: Weak<Waiting>, connection: Connection, limit: Duration) {
    loop {
        sleep(limit / LOOKS).await;
        match waiting.upgrade() {
            None => return,
            Some(waiting) if waiting.elapsed() > limit => {
                let seconds = limit.as_secs();
                tracing::warn!(peer = ?connection.peer, seconds, "ended a connection that did not read its replies");
                return connection.end();
            }
            Some(_) => {}
        }
    }
}

impl HttpBody for Replies {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Self { body, outbox, waiting } = &mut *self;
        let polled = Pin::new(body).poll_frame(context);
        polled.map_ok(|frame| frame.map_data(|bytes| outbox.send(bytes, || Unread::new(waiting))))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
