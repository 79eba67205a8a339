//! A client's side of a lease: stores unanswered requests, and resumes a session whose connection was lost.

use std::collections::VecDeque;
use std::error::Error;
use std::fmt;
use std::io::ErrorKind;
use std::time::Duration;

use bytes::Bytes;
use tokio::time::{Instant, sleep};
use tonic::{Code, Status};

use super::{RawStream, TypedRequest};
use crate::connection::Connection;
use crate::proto::{self, SessionRequest, SessionResponse, session_response::Response};

/// Pause between the first and the second attempt to resume. The first attempt is immediate, and the pause doubles
/// after each attempt.
const MIN_PAUSE: Duration = Duration::from_millis(50);
/// Maximal pause between two attempts to resume.
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// Number of resumptions of the session without a reply in between, after which the next loss of the connection ends
/// the session.
pub(super) const MAX_RESUMES_WITHOUT_REPLY: u32 = 8;
/// Number of refused connections in a row after which the client stops trying: no server listens at the address any
/// more.
const MAX_REFUSED: u32 = 4;

/// The right to resume a session over a new connection, and the unanswered requests to send again.
pub(super) struct ClientLease {
    name: Bytes,
    time: Duration,
    last_reply: u64,
    /// Requests whose replies were not received, oldest first. The next reply, with the number `last_reply` + 1,
    /// answers the oldest request.
    waiting: VecDeque<SessionRequest>,
}

/// The reason why an attempt to resume a session failed.
enum ResumeFailure {
    /// Another attempt may succeed.
    Retry,
    /// No server listens at the address.
    Refused,
    /// No attempt can succeed.
    Permanent,
}

/// Leaves out the lease's name, which is a secret.
impl fmt::Debug for ClientLease {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("ClientLease")
            .field("time", &self.time)
            .field("last_reply", &self.last_reply)
            .finish_non_exhaustive()
    }
}

impl ClientLease {
    /// Returns the lease that the server granted; `None` if it granted none.
    pub(super) fn from_proto(opened: &proto::Opened) -> Option<Self> {
        let time = Duration::from_secs(opened.lease_seconds.into());
        (!opened.lease.is_empty()).then(|| Self {
            name: opened.lease.clone(),
            time,
            last_reply: 0,
            waiting: VecDeque::new(),
        })
    }

    /// Stores a request that is being sent, so that it can be sent again after a resumption.
    pub(super) fn on_request(&mut self, request: &SessionRequest) {
        self.waiting.push_back(request.clone());
    }

    /// Counts a received reply, and drops its request.
    pub(super) fn on_reply(&mut self) {
        self.waiting.pop_front();
        self.last_reply += 1;
    }

    /// Resumes the session over a new stream, and sends again the requests that did not reach the server. Retries until
    /// the lease ends. Returns `None` if it ended, if no server listens any more, or if the server no longer has the
    /// session.
    pub(super) async fn resume(&self, connection: &Connection) -> Option<RawStream> {
        let since = Instant::now();
        let mut pause = MIN_PAUSE;
        let mut refused = 0;
        while since.elapsed() < self.time {
            match self.attempt(connection).await {
                Ok(stream) => return Some(stream),
                Err(ResumeFailure::Permanent) => return None,
                Err(ResumeFailure::Refused) => refused += 1,
                Err(ResumeFailure::Retry) => refused = 0,
            }
            if refused == MAX_REFUSED {
                return None;
            }
            sleep(pause).await;
            pause = (pause * 2).min(MAX_PAUSE);
        }
        None
    }

    async fn attempt(&self, connection: &Connection) -> Result<RawStream, ResumeFailure> {
        let resume = proto::Resume { lease: self.name.clone(), last_reply: self.last_reply };
        // No new channel is needed: tonic's channel reconnects by itself.
        let begun = RawStream::begin(connection, resume, self.waiting.len()).await.map_err(|_| ResumeFailure::Retry)?;
        let mut stream = begun.map_err(ResumeFailure::from_status)?;
        let limit = connection.timeouts().reply;
        let reply = tokio::time::timeout(limit, stream.replies.message()).await.map_err(|_| ResumeFailure::Retry)?;
        let Some(SessionResponse { response: Some(response) }) = reply.map_err(ResumeFailure::from_status)? else {
            return Err(ResumeFailure::Permanent);
        };
        if let Response::Error(error) = &response
            && error.code == i32::from(Code::ResourceExhausted)
        {
            return Err(ResumeFailure::Retry);
        }
        // Any response other than `Resumed`, most likely an error, is final.
        let resumed = proto::Resume::reply(response).map_err(|_| ResumeFailure::Permanent)?;
        let arrived = resumed.last_reply.checked_sub(self.last_reply).ok_or(ResumeFailure::Permanent)?;
        let arrived = usize::try_from(arrived).map_err(|_| ResumeFailure::Permanent)?;
        for request in self.waiting.iter().skip(arrived) {
            stream.requests.send(request.clone()).await.map_err(|_| ResumeFailure::Retry)?;
        }
        Ok(stream)
    }
}

impl ResumeFailure {
    fn from_status(status: Status) -> Self {
        match system_error(&status) {
            Some(ErrorKind::ConnectionRefused | ErrorKind::NotFound) => Self::Refused,
            _ if is_of_connection(&status) || status.code() == Code::ResourceExhausted => Self::Retry,
            _ => Self::Permanent,
        }
    }
}

/// Whether a call ended because the connection failed, and not by the server's own status.
pub(super) fn is_of_connection(status: &Status) -> bool {
    status.source().is_some()
}

/// Returns the kind of the operating system's error among a status's sources.
fn system_error(status: &Status) -> Option<ErrorKind> {
    let mut chain = std::iter::successors(status.source(), |error: &&(dyn Error + 'static)| (*error).source());
    chain.find_map(|error| error.downcast_ref::<std::io::Error>()).map(std::io::Error::kind)
}
