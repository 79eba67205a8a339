//! The gRPC service of `perturb.v1`.

use super::session::{ServerContext, Session};
use crate::{
    proto::{self, perturb_server::Perturb},
    server::{
        auth::Bearer,
        error::status,
        session::{admission::Sessions, driver::Responses, instrumented::RequestCounters},
        shutdown::Drain,
        transport::raw_body,
    },
};
use std::{sync::Arc, time::Duration};
use tonic::{Request, Response, Status, Streaming};

/// The price of a call for the catalogue, in steps.
const LISTING_PRICE: u64 = 16;
/// The maximum time that a call for the catalogue waits for its token's rate. It is shorter than the timeout of unary
/// calls.
const MAX_LISTING_WAIT: Duration = Duration::from_secs(5);

/// The path of the gRPC method whose calls are sessions.
pub const ENDPOINT: &str = "/perturb.v1.Perturb/Session";

/// The service of `perturb.v1`: the catalogue, and sessions.
#[derive(Clone)]
pub struct PerturbService {
    context: Arc<ServerContext>,
    sessions: Sessions,
    counts: Arc<RequestCounters>,
}

impl PerturbService {
    /// Makes a service whose sessions use the parts of the server in `context`, within the limits of `sessions`.
    pub fn new(context: ServerContext, sessions: Sessions) -> Self {
        Self { context: Arc::new(context), sessions, counts: RequestCounters::new::<Session>() }
    }

    /// Returns a handle to the same service that observes the shutdown through `drain`.
    pub fn with_drain(&self, drain: Drain) -> Self {
        Self { sessions: self.sessions.with_drain(drain), ..self.clone() }
    }

    /// Returns the counters of requests.
    pub fn counts(&self) -> Arc<RequestCounters> {
        Arc::clone(&self.counts)
    }
}

#[tonic::async_trait]
impl Perturb for PerturbService {
    type SessionStream = Responses<proto::SessionResponse>;

    async fn list_environments(
        &self,
        request: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        if let Some(bearer) = request.extensions().get::<Bearer>() {
            bearer.acquire_within(MAX_LISTING_WAIT).await.map_err(|error| status(&error))?;
            bearer.charge(0, LISTING_PRICE);
        }
        Ok(Response::new(self.context.listing.clone()))
    }

    async fn session(
        &self,
        mut request: Request<Streaming<proto::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let reader = raw_body::messages(&mut request)?;
        let session = Session::new(Arc::clone(&self.context), reader.bearer.clone(), reader.budget().clone());
        Ok(Response::new(self.sessions.begin(reader, session, &self.counts)?))
    }
}
