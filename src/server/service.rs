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
    listing: Arc<proto::ListEnvironmentsResponse>,
    renderer: Arc<Renderer>,
    sessions: Sessions,
}

impl Service {
    /// A service over a pool.
    pub fn new(
        pool: Arc<Pool>,
        catalogue: Arc<Catalogue>,
        listing: Arc<proto::ListEnvironmentsResponse>,
        sessions: Sessions,
    ) -> Self {
        Self { pool, catalogue, listing, renderer: Arc::default(), sessions }
    }
}

#[tonic::async_trait]
impl Perturb for Service {
    type SessionStream = Responses<proto::SessionResponse>;

    async fn list_environments(
        &self,
        _: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        Ok(Response::new(self.listing.as_ref().clone()))
    }

    async fn session(
        &self,
        requests: Request<Streaming<proto::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let Self { pool, catalogue, listing, renderer, .. } = self.clone();
        let session = Session::new(pool, catalogue, listing, renderer);
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
