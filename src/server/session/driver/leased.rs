//! A conversation with a lease: a task of its own, which streams come to and are lost from. What was asked for is done
//! whether or not anybody waits for it, and the last replies are kept.

use super::{Conversation, refused, revoked};
use crate::server::{
    error::{ErrorKind, RequestError, status},
    net::access_log::{CLOSED, GONE, LEASE_OVER},
    session::{
        Error,
        handler::Dialogue,
        lease::{self, Arrived, Ask, Grant, Line, Ticket},
        replay_buffer::Kept,
    },
    transport::{
        budget::{Outbox, Share},
        message_reader::Stop,
    },
};
use prost::Message;
use tokio::{
    sync::oneshot,
    time::{Instant, sleep_until},
};
use tonic::Status;

/// The most bytes that the replies of one session keep, unless the last one alone has more: a client that has not heard of
/// that much is better off with a snapshot.
const MOST_KEPT: usize = 4 << 20;
/// A kept reply's bytes beside those that are sent.
const REST: usize = 512;

/// Has a conversation go on in a task, whose first stream takes responses from `line`.
pub(super) fn begin<D: Dialogue>(
    mut conversation: Conversation<D>,
    grant: Grant<D::Response>,
    line: Line<D::Response>,
) {
    let kept = Kept::new(grant.most);
    // What came ahead would be lost with its stream, and come again.
    conversation.reads_ahead = false;
    tokio::spawn(Leased { conversation, grant, kept, sent: 0 }.run(line));
}

struct Leased<D: Dialogue> {
    conversation: Conversation<D>,
    grant: Grant<D::Response>,
    /// With their shares of the budget; one without is let go when it is sent.
    kept: Kept<(D::Response, Option<Share>)>,
    /// The number of the last reply that this stream has.
    sent: u64,
}

/// Where a session is.
enum At<R> {
    /// It has a stream.
    Line(Line<R>),
    /// It has none; one may be about to come.
    Nowhere(Option<Coming<R>>),
}

type Coming<R> = oneshot::Receiver<Arrived<R>>;

impl<D: Dialogue> Leased<D> {
    async fn run(mut self, line: Line<D::Response>) {
        let mut at = Some(At::Line(line));
        while let Some(place) = at {
            at = match place {
                At::Line(line) => self.attached(line).await,
                At::Nowhere(coming) => self.detached(coming).await,
            };
        }
    }

    /// Answers a stream's requests, until it is lost, or another takes its place, or the session ends.
    async fn attached(&mut self, line: Line<D::Response>) -> Option<At<D::Response>> {
        loop {
            let Self { conversation, grant, .. } = self;
            if self.sent < self.kept.last() {
                let bearer = conversation.requests.bearer.clone();
                tokio::select! {
                    biased;
                    () = conversation.sessions.drain.closed() => {
                        return self.stopped(line.clone(), refused(Error::Draining));
                    }
                    error = revoked(bearer.as_ref()) => return self.stopped(line.clone(), refused(error)),
                    Some(ask) = grant.asks.recv() => if let Some(coming) = self.agree(ask) {
                        return Some(self.give_way(line.clone(), coming));
                    },
                    room = line.reserve() => match room {
                        Ok(room) => {
                            self.sent += 1;
                            if let Some((reply, share)) = self.kept.get(self.sent) {
                                room.send(Ok(reply.clone()));
                                if share.is_none() {
                                    self.kept.clear();
                                }
                            }
                        }
                        Err(_) => return Some(self.lost(None)),
                    },
                }
                continue;
            }
            tokio::select! {
                biased; // a client's own end comes before that of its connection
                Some(ask) = grant.asks.recv() => if let Some(coming) = self.agree(ask) {
                    return Some(self.give_way(line, coming));
                },
                request = conversation.request() => match request {
                    Ok(Some(message)) => {
                        self.kept.asked();
                        match self.conversation.answer(message).await {
                            Ok(answer) => self.keep(answer),
                            Err(stop) => return self.stopped(line, stop),
                        }
                    }
                    Ok(None) => {
                        self.conversation.ending = CLOSED;
                        return None;
                    }
                    Err(stop) => return self.stopped(line, stop),
                },
                () = line.closed() => return Some(self.lost(None)),
            }
        }
    }

    /// Waits for another stream, until the lease is over.
    async fn detached(&mut self, mut coming: Option<Coming<D::Response>>) -> Option<At<D::Response>> {
        let _counted = self.grant.numbers().detach();
        let over = Instant::now() + self.grant.time();
        let bearer = self.conversation.requests.bearer.clone();
        loop {
            let Self { conversation, grant, .. } = self;
            let error = tokio::select! {
                biased;
                () = conversation.sessions.drain.draining() => Some(Error::Draining),
                error = revoked(bearer.as_ref()) => Some(error.into()),
                arrived = arrival(&mut coming) => {
                    coming = None;
                    match arrived {
                        Ok(Arrived { requests, line }) => {
                            conversation.dialogue.attach(requests.outbox.clone());
                            conversation.requests = requests;
                            conversation.resumed += 1;
                            conversation.ending = GONE;
                            grant.numbers().add_resumed();
                            return Some(At::Line(line));
                        }
                        Err(_) => continue, // that stream was lost, too
                    }
                }
                Some(ask) = grant.asks.recv() => {
                    coming = self.agree(ask).or(coming);
                    continue;
                }
                () = sleep_until(over) => None,
            };
            match error {
                Some(error) => self.conversation.end_by(&error),
                None => self.conversation.ending = LEASE_OVER,
            }
            return None;
        }
    }

    /// Answers a stream that asks for the session; whether it is to come.
    fn agree(&mut self, Ask { last_reply, answer }: Ask<D::Response>) -> Option<Coming<D::Response>> {
        if let Err(error) = self.kept.check(last_reply) {
            let _ = answer.send(Err(error)); // whoever is gone does not hear it
            return None;
        }
        let (arrival, coming) = oneshot::channel();
        answer.send(Ok(Ticket { last_reply: self.kept.last(), arrival })).ok()?;
        self.sent = last_reply;
        Some(coming)
    }

    /// Has the stream end: another takes its place.
    fn give_way(&mut self, line: Line<D::Response>, coming: Coming<D::Response>) -> At<D::Response> {
        tell(line, status(&lease::Error::TakenUp));
        self.lost(Some(coming))
    }

    /// Leaves the stream alone.
    fn lost(&mut self, coming: Option<Coming<D::Response>>) -> At<D::Response> {
        drop(self.conversation.requests.leave());
        self.conversation.dialogue.attach(Outbox::default());
        At::Nowhere(coming)
    }

    /// A stream cannot go on: that is its client's loss, unless the session is to end.
    fn stopped(&mut self, line: Line<D::Response>, stop: Stop<D::Error>) -> Option<At<D::Response>> {
        match stop {
            Stop::Cancelled => Some(self.lost(None)),
            Stop::Broken(status) => {
                tell(line, status);
                Some(self.lost(None))
            }
            Stop::Refused(_) => {
                if let Err(status) = self.conversation.told(Err(stop)) {
                    tell(line, status);
                }
                None
            }
        }
    }

    /// Keeps an answer as a reply. Where the budget has no room beside those before, they go.
    fn keep(&mut self, answer: Result<D::Response, D::Error>) {
        let wants_room =
            |kind| matches!(kind, ErrorKind::MemoryFull | ErrorKind::TokenQuota | ErrorKind::MoreThanTokenQuota);
        if answer.as_ref().is_err_and(|error| wants_room(error.kind())) {
            self.kept.clear(); // they were received, and may be what is in the way
        }
        let Ok(reply) = self.conversation.told(Ok(answer)) else { return };
        let (budget, bytes) = (self.conversation.requests.budget().clone(), reply.encoded_len() + REST);
        let held: usize = self.kept.replies().map(|(_, share)| share.as_ref().map_or(0, Share::bytes)).sum();
        let mut share = budget.take(bytes);
        if share.is_err() || held + bytes > MOST_KEPT {
            self.kept.clear();
            share = share.or_else(|_| budget.take(bytes));
        }
        self.kept.made((reply, share.ok()));
    }
}

/// Sends a stream's status as soon as it can be sent; then the stream ends.
fn tell<R: Send + 'static>(line: Line<R>, status: Status) {
    tokio::spawn(async move { line.send(Err(status)).await });
}

/// Waits for a stream that is about to come, or for ever.
async fn arrival<R>(coming: &mut Option<Coming<R>>) -> Result<Arrived<R>, oneshot::error::RecvError> {
    match coming {
        Some(coming) => coming.await,
        None => std::future::pending().await,
    }
}
