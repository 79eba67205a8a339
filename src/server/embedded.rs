//! A server inside a client's process. It has the same pool and the same session handler as `perturb-server`, but no
//! network: a program that links this library, such as the Python package's native module, passes requests and receives
//! replies as messages.
//!
//! The limits are the limits of `perturb-server --private`, except that the number of sessions is unlimited. Only this
//! process uses the server, so there are no tokens, no leases, no ledger and no metrics.

use super::{
    api::perturb_v1::{
        Error,
        session::{ServerContext, Session},
    },
    error::status,
    limits::RequestLimits,
    session::{handler::SessionHandler, lease::Leases},
    startup::listing,
    transport::{self, budget::Budget, precheck::Decoder},
};
use crate::{
    config::{self, Arguments, Config},
    env::{self, Catalogue},
    pool::Pool,
    proto::{SessionRequest, SessionResponse, session_request::Request},
    render::Renderer,
};
use prost::Message;
use std::{io, sync::Arc, time::Duration};
use tonic::Status;

/// Why an embedded server cannot start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// An environment cannot be built.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The operating system cannot start a thread.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The built-in settings of a private server are invalid, which is a defect.
    #[error(transparent)]
    Config(#[from] config::Error),
}

/// A server in this process. The server's threads end when the server and all its sessions have been dropped.
pub struct EmbeddedServer {
    context: Arc<ServerContext>,
    budget: Budget,
    decoder: Decoder,
    /// The maximum length of a request, bytes.
    max_bytes: usize,
}

impl EmbeddedServer {
    /// Starts a server, and its threads, for the environments of `catalogue`.
    ///
    /// # Errors
    /// [`StartError`], if an environment or a thread cannot be made.
    pub fn start(catalogue: Catalogue) -> Result<Self, StartError> {
        let config = Config {
            lease_seconds: 0, // there is no connection that could be lost
            ..Config::load(&Arguments { private: true, ..Arguments::default() })?
        };
        let context = ServerContext {
            pool: Arc::new(Pool::new(config.workers, config.max_envs)?),
            listing: listing(&catalogue, &config)?,
            catalogue: Arc::new(catalogue),
            renderer: Renderer::new(),
            ledger: None,
            leases: Leases::new(Duration::from_secs(config.lease_seconds), Default::default()),
        };
        Ok(Self {
            context: Arc::new(context),
            budget: Budget::new(config.max_memory),
            decoder: Decoder::default(),
            max_bytes: config.max_message_bytes,
        })
    }

    /// Starts a session. Its first request must be `Open`.
    pub fn session(&self) -> EmbeddedSession {
        let handler = Session::new(Arc::clone(&self.context), None, self.budget.clone());
        EmbeddedSession { handler, decoder: self.decoder.clone(), max_bytes: self.max_bytes }
    }
}

/// A session of an embedded server. Dropping it frees its environments.
pub struct EmbeddedSession {
    handler: Session,
    decoder: Decoder,
    max_bytes: usize,
}

impl EmbeddedSession {
    /// Answers a request. If the request is refused, the response says why, and the session stays open. Must be called
    /// within a tokio runtime. A small batch is stepped on the thread that polls the future, during the first poll.
    ///
    /// # Errors
    /// The gRPC status with which `perturb-server` would end the session's stream, e.g. if the request is too large.
    pub async fn answer(&mut self, request: SessionRequest) -> Result<SessionResponse, Status> {
        let request = match request.request {
            // A step contains only actions, and the handler checks their length.
            Some(Request::Step(_)) => Ok(request),
            _ => Box::pin(self.checked(request)).await?,
        };
        let answer = match request {
            Ok(request) => self.handler.answer(request).await,
            Err(refusal) => Err(refusal),
        };
        Ok(answer.map_or_else(Session::error_response, |reply| reply.response))
    }

    /// Returns a function that queues the next step in the pool while `request` runs, or `None` if the next step must
    /// wait. If a step is passed to this function, the next call of [`answer`](Self::answer) must be for that step.
    pub fn pipeline(&self, request: &SessionRequest) -> Option<impl FnOnce(SessionRequest) + Send + use<>> {
        self.handler.pipeline(request)
    }

    /// Checks a request's size and its numbers of entries, as `perturb-server` does before decoding. Returns the
    /// request. The inner error is the reason for refusing the request, e.g. too many entries.
    ///
    /// # Errors
    /// The gRPC status with which `perturb-server` would end the session's stream, e.g. if the request is too large.
    async fn checked(&self, request: SessionRequest) -> Result<Result<SessionRequest, Error>, Status> {
        let limits = self.handler.request_limits();
        let limits = RequestLimits { bytes: limits.bytes.min(self.max_bytes), ..limits };
        let got = request.encoded_len();
        if got > limits.bytes {
            return Err(status(&transport::Error::TooLarge { got, limit: limits.bytes }));
        }
        // The decoder counts the entries in encoded bytes, so the request is encoded for it.
        let decoded = self.decoder.decode(request.encode_to_vec().into(), Session::FIELDS, limits).await?;
        Ok(decoded.map_err(|refusal| transport::Error::from(refusal).into()))
    }
}
