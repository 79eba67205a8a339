//! A client's side of a lease: the requests without replies, and the resumption of a session whose connection was lost.

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

/// Pause between the first attempt, which is immediate, and the second. The pause doubles with each attempt.
const MIN_PAUSE: Duration = Duration::from_millis(50);
/// Upper limit of the pause between two attempts.
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// Number of losses in a row without a reply, after which the session is given up.
pub(super) const MAX_RESUMES_WITHOUT_REPLY: u32 = 8;
/// Number of refused connections in a row, after which the server counts as gone.
const MAX_REFUSED: u32 = 4;

/// A lease, by which a session is resumed.
pub(super) struct ClientLease {
    name: Bytes,
    time: Duration,
    last_reply: u64,
    /// Requests without a reply. The reply to the first has the number after `last_reply`.
    waiting: VecDeque<SessionRequest>,
}

/// Why a session was not resumed.
enum ResumeFailure {
    /// Another attempt may succeed.
    Retry,
    /// No server listens at the address.
    Refused,
    /// No attempt can succeed.
    Permanent,
}

/// Hides the lease's name, which is a secret.
impl fmt::Debug for ClientLease {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("ClientLease")
            .field("time", &self.time)
            .field("last_reply", &self.last_reply)
            .finish_non_exhaustive()
    }
}

impl ClientLease {
    /// The lease that a server granted, if it did.
    pub(super) fn from_proto(opened: &proto::Opened) -> Option<Self> {
        let time = Duration::from_secs(opened.lease_seconds.into());
        (!opened.lease.is_empty()).then(|| Self {
            name: opened.lease.clone(),
            time,
            last_reply: 0,
            waiting: VecDeque::new(),
        })
    }

    /// Notes a request that is sent.
    pub(super) fn on_request(&mut self, request: &SessionRequest) {
        self.waiting.push_back(request.clone());
    }

    /// Notes a reply that was received.
    pub(super) fn on_reply(&mut self) {
        self.waiting.pop_front();
        self.last_reply += 1;
    }

    /// Resumes the session over another stream, and sends those requests again that did not arrive. Tries until the lease ends,
    /// unless the server is gone or no longer has the session.
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
        // The channel connects again by itself.
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
        // Any other response is most likely an error.
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

/// Whether a call was ended by the connection, and not by the server.
pub(super) fn is_of_connection(status: &Status) -> bool {
    status.source().is_some()
}

/// The operating system's error of a connection.
fn system_error(status: &Status) -> Option<ErrorKind> {
    let mut chain = std::iter::successors(status.source(), |error: &&(dyn Error + 'static)| (*error).source());
    chain.find_map(|error| error.downcast_ref::<std::io::Error>()).map(std::io::Error::kind)
}
