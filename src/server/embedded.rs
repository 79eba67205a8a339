//! A server inside of a client's process: the same pool and the same handler of sessions, and no transport. A program
//! that links this library, such as the Python package's native module, hands requests over as messages and gets
//! replies as messages.
//!
//! Limits are those of `perturb-server --private`, except that the number of sessions is not limited. Nobody else uses
//! the server, so there are no tokens, no leases, no ledger and no metrics.

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

/// Why there is no server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// An environment cannot be built.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The operating system cannot start a thread.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The settings of a private server are refused: a defect.
    #[error(transparent)]
    Config(#[from] config::Error),
}

/// A server of this process. Its threads end when it and its last session are dropped.
pub struct EmbeddedServer {
    context: Arc<ServerContext>,
    budget: Budget,
    decoder: Decoder,
    /// The most bytes of a request.
    max_bytes: usize,
}

impl EmbeddedServer {
    /// Starts the threads of a server of these environments.
    ///
    /// # Errors
    /// [`StartError`].
    pub fn start(catalogue: Catalogue) -> Result<Self, StartError> {
        let config = Config {
            lease_seconds: 0, // no connection is lost
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

    /// A session that is not open yet.
    pub fn session(&self) -> EmbeddedSession {
        let handler = Session::new(Arc::clone(&self.context), None, self.budget.clone());
        EmbeddedSession { handler, decoder: self.decoder.clone(), max_bytes: self.max_bytes }
    }
}

/// A session. Dropping it frees its environments.
pub struct EmbeddedSession {
    handler: Session,
    decoder: Decoder,
    max_bytes: usize,
}

impl EmbeddedSession {
    /// Answers a request. A refusal is a response, too, and the session stays open. Needs the context of a tokio
    /// runtime. A step of a small batch is done when the future is polled for the first time, on the thread that polls.
    ///
    /// # Errors
    /// The status with which a server would end the stream.
    pub async fn answer(&mut self, request: SessionRequest) -> Result<SessionResponse, Status> {
        let request = match request.request {
            // A step has nothing but its actions, which the handler checks.
            Some(Request::Step(_)) => Ok(request),
            _ => Box::pin(self.checked(request)).await?,
        };
        let answer = match request {
            Ok(request) => self.handler.answer(request).await,
            Err(refusal) => Err(refusal),
        };
        Ok(answer.map_or_else(Session::error_response, |reply| reply.response))
    }

    /// Returns a function that offers the next step to the pool while `request` runs, or `None` if the next step must
    /// wait. The caller must have a step that it offered answered next.
    pub fn pipeline(&self, request: &SessionRequest) -> Option<impl FnOnce(SessionRequest) + Send + use<>> {
        self.handler.pipeline(request)
    }

    /// Bounds a request's size and counts its entries, as a server does.
    async fn checked(&self, request: SessionRequest) -> Result<Result<SessionRequest, Error>, Status> {
        let limits = self.handler.request_limits();
        let limits = RequestLimits { bytes: limits.bytes.min(self.max_bytes), ..limits };
        let got = request.encoded_len();
        if got > limits.bytes {
            return Err(status(&transport::Error::TooLarge { got, limit: limits.bytes }));
        }
        let decoded = self.decoder.decode(request.encode_to_vec().into(), Session::FIELDS, limits).await?;
        Ok(decoded.map_err(|refusal| transport::Error::from(refusal).into()))
    }
}
