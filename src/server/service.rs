//! The gRPC service: one short method for each call.

use super::{
    drain::{Drain, Phase},
    session::Session,
    status::Refusal,
};
use crate::{
    pool::Pool,
    proto::{self, perturb_server::Perturb},
    render::Renderer,
};
use futures_util::{Stream, stream};
use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};
use tonic::{Request, Response, Status, Streaming};

/// Serves the catalogue and sessions.
#[derive(Clone)]
pub struct Service {
    pool: Arc<Pool>,
    catalogue: Arc<[proto::Environment]>,
    renderer: Arc<Renderer>,
    sessions: Arc<AtomicUsize>,
    max_sessions: usize,
    idle: Option<Duration>,
    drain: Drain,
}

impl Service {
    /// A service over a pool. A session may be idle for `idle`, or for ever.
    pub fn new(
        pool: Arc<Pool>,
        catalogue: Arc<[proto::Environment]>,
        max_sessions: usize,
        idle: Option<Duration>,
        drain: Drain,
    ) -> Self {
        Self { pool, catalogue, renderer: Arc::default(), sessions: Arc::default(), max_sessions, idle, drain }
    }
}

type Responses = Pin<Box<dyn Stream<Item = Result<proto::SessionResponse, Status>> + Send>>;

#[tonic::async_trait]
impl Perturb for Service {
    type SessionStream = Responses;

    async fn list_environments(
        &self,
        _: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        Ok(Response::new(proto::ListEnvironmentsResponse {
            environments: self.catalogue.to_vec(),
            server_version: env!("CARGO_PKG_VERSION").into(),
            max_batch_size: u32::try_from(self.pool.max_environments()).unwrap_or(u32::MAX),
        }))
    }

    async fn session(
        &self,
        requests: Request<Streaming<proto::SessionRequest>>,
    ) -> Result<Response<Responses>, Status> {
        if self.drain.phase() != Phase::Running {
            return Err(Refusal::Draining.into());
        }
        let Some(ticket) = Ticket::take(&self.sessions, self.max_sessions) else {
            return Err(Refusal::TooManySessions { limit: self.max_sessions }.into());
        };
        let conversation = Conversation {
            requests: requests.into_inner(),
            session: Session::new(Arc::clone(&self.pool), Arc::clone(&self.catalogue), Arc::clone(&self.renderer)),
            idle: self.idle,
            drain: self.drain.enter(),
            _ticket: ticket,
        };
        // Polled by the connection: when the client is gone the stream is dropped, and the environments with it.
        let responses = stream::unfold(Some(conversation), |conversation| async {
            let mut conversation = conversation?;
            match conversation.next().await? {
                Ok(response) => Some((Ok(response), Some(conversation))),
                Err(status) => Some((Err(status), None)),
            }
        });
        Ok(Response::new(Box::pin(responses)))
    }
}

/// A session and its transport.
struct Conversation {
    requests: Streaming<proto::SessionRequest>,
    session: Session,
    idle: Option<Duration>,
    drain: Drain,
    _ticket: Ticket,
}

impl Conversation {
    /// The next response; an error ends the stream, and so does the client's end.
    async fn next(&mut self) -> Option<Result<proto::SessionResponse, Status>> {
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
        if self.drain.phase() != Phase::Running && !self.session.is_open() {
            return Some(Err(Refusal::Draining.into()));
        }
        Some(Ok(self.session.answer(request).await))
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
