//! A client's side of a lease: what it has not received yet, and how it takes up a session whose connection was lost.

use std::collections::VecDeque;
use std::error::Error;
use std::fmt;
use std::io::ErrorKind;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::{Instant, sleep};
use tonic::{Code, Status};

use super::{Ask, Line};
use crate::connection::Connection;
use crate::proto::{self, SessionRequest, SessionResponse, session_response::Response};

/// After the first attempt, which is at once, the pause before the next; it doubles with each …
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// … up to this.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// A line that breaks so often in a row before a reply comes will not carry it.
pub(super) const MOST_WITHOUT_REPLY: u32 = 8;
/// Where nobody listens this often in a row, the server is gone, and not the line to it.
const REFUSED: u32 = 4;

/// What a session is taken up by.
pub(super) struct Lease {
    name: Bytes,
    time: Duration,
    last_reply: u64,
    /// Requests that have no reply yet; the first one's is that after `last_reply`.
    waiting: VecDeque<SessionRequest>,
}

/// Why a session was not taken up.
enum Failure {
    /// It may be, later.
    Now,
    /// Nobody listens there.
    Refused,
    /// It never will.
    Ever,
}

/// Its name is a secret.
impl fmt::Debug for Lease {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("Lease")
            .field("time", &self.time)
            .field("last_reply", &self.last_reply)
            .finish_non_exhaustive()
    }
}

impl Lease {
    /// The one that a server gave, if it did.
    pub(super) fn of(opened: &proto::Opened) -> Option<Self> {
        let time = Duration::from_secs(opened.lease_seconds.into());
        (!opened.lease.is_empty()).then(|| Self {
            name: opened.lease.clone(),
            time,
            last_reply: 0,
            waiting: VecDeque::new(),
        })
    }

    /// A request is sent.
    pub(super) fn asked(&mut self, request: &SessionRequest) {
        self.waiting.push_back(request.clone());
    }

    /// A reply has come.
    pub(super) fn answered(&mut self) {
        self.waiting.pop_front();
        self.last_reply += 1;
    }

    /// Takes the session up by another stream, on which those requests are sent again that did not arrive. Tries as long as
    /// the lease holds, unless the server is gone or has it no more.
    pub(super) async fn take_up(&self, connection: &Connection) -> Option<Line> {
        let (since, mut pause, mut refused) = (Instant::now(), FIRST_PAUSE, 0);
        while since.elapsed() < self.time {
            match self.attempt(connection).await {
                Ok(line) => return Some(line),
                Err(Failure::Ever) => return None,
                Err(Failure::Refused) => refused += 1,
                Err(Failure::Now) => refused = 0,
            }
            if refused == REFUSED {
                return None;
            }
            sleep(pause).await;
            pause = (pause * 2).min(LONGEST_PAUSE);
        }
        None
    }

    async fn attempt(&self, connection: &Connection) -> Result<Line, Failure> {
        let resume = proto::Resume { lease: self.name.clone(), last_reply: self.last_reply };
        // The channel connects again by itself.
        let begun = Line::begin(connection, resume, self.waiting.len()).await.map_err(|_| Failure::Now)?;
        let mut line = begun.map_err(Failure::of)?;
        let limit = connection.patience().reply;
        let reply = tokio::time::timeout(limit, line.replies.message()).await.map_err(|_| Failure::Now)?;
        let Some(SessionResponse { response: Some(response) }) = reply.map_err(Failure::of)? else {
            return Err(Failure::Ever);
        };
        if let Response::Error(error) = &response
            && error.code == i32::from(Code::ResourceExhausted)
        {
            return Err(Failure::Now);
        }
        // A refusal, most likely.
        let resumed = proto::Resume::reply(response).map_err(|_| Failure::Ever)?;
        let arrived = resumed.last_reply.checked_sub(self.last_reply).ok_or(Failure::Ever)?;
        let arrived = usize::try_from(arrived).map_err(|_| Failure::Ever)?;
        for request in self.waiting.iter().skip(arrived) {
            line.requests.send(request.clone()).await.map_err(|_| Failure::Now)?;
        }
        Ok(line)
    }
}

impl Failure {
    fn of(status: Status) -> Self {
        match system_error(&status) {
            Some(ErrorKind::ConnectionRefused | ErrorKind::NotFound) => Self::Refused,
            _ if is_of_the_line(&status) || status.code() == Code::ResourceExhausted => Self::Now,
            _ => Self::Ever,
        }
    }
}

/// Whether the connection ended a call, and not the server.
pub(super) fn is_of_the_line(status: &Status) -> bool {
    status.source().is_some()
}

/// What the operating system has against a connection.
fn system_error(status: &Status) -> Option<ErrorKind> {
    let mut chain = std::iter::successors(status.source(), |error: &&(dyn Error + 'static)| (*error).source());
    chain.find_map(|error| error.downcast_ref::<std::io::Error>()).map(std::io::Error::kind)
}
