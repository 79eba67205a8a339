//! The gRPC service of `perturb.v1`: one short method for each call.

use super::{
    conversation::{Dialogue, Responses, Sessions},
    session::Session,
};
use crate::{
    env::Catalogue,
    pool::Pool,
    proto::{self, perturb_server::Perturb},
    render::Renderer,
};
use std::sync::Arc;
use tonic::{Request, Response, Status, Streaming};

/// Serves the catalogue and sessions.
#[derive(Clone)]
pub struct Service {
    pool: Arc<Pool>,
    catalogue: Arc<Catalogue>,
    /// The catalogue as the protocol tells it.
    entries: Arc<[proto::Environment]>,
    renderer: Arc<Renderer>,
    sessions: Sessions,
}

impl Service {
    /// A service over a pool.
    pub fn new(
        pool: Arc<Pool>,
        catalogue: Arc<Catalogue>,
        entries: Arc<[proto::Environment]>,
        sessions: Sessions,
    ) -> Self {
        Self { pool, catalogue, entries, renderer: Arc::default(), sessions }
    }
}

#[tonic::async_trait]
impl Perturb for Service {
    type SessionStream = Responses<proto::SessionResponse>;

    async fn list_environments(
        &self,
        _: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        Ok(Response::new(proto::ListEnvironmentsResponse {
            environments: self.entries.to_vec(),
            server_version: env!("CARGO_PKG_VERSION").into(),
            max_batch_size: u32::try_from(self.pool.max_environments()).unwrap_or(u32::MAX),
        }))
    }

    async fn session(
        &self,
        requests: Request<Streaming<proto::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let Self { pool, catalogue, entries, renderer, .. } = self.clone();
        let session = Session::new(pool, catalogue, entries, renderer);
        Ok(Response::new(self.sessions.begin(requests.into_inner(), session)?))
    }
}

impl Dialogue for Session {
    type Request = proto::SessionRequest;
    type Response = proto::SessionResponse;

    fn is_open(&self) -> bool {
        Session::is_open(self)
    }

    fn answer(&mut self, request: Self::Request) -> impl Future<Output = Self::Response> + Send {
        Session::answer(self, request)
    }
}
