//! The gRPC service of `dm_env_rpc.v1`: one stream for each agent.

use super::{agent::Agent, worlds::Worlds};
use crate::{
    env::Catalogue,
    pool::Pool,
    proto::dm_env_rpc::v1::{EnvironmentRequest, EnvironmentResponse, environment_server::Environment},
    server::conversation::{Dialogue, Responses, Sessions},
};
use std::sync::Arc;
use tonic::{Request, Response, Status, Streaming};

/// Serves worlds, which all streams share.
#[derive(Clone)]
pub struct Service {
    worlds: Arc<Worlds>,
    sessions: Sessions,
}

impl Service {
    /// A service over a pool, without worlds.
    pub fn new(pool: Arc<Pool>, catalogue: Arc<Catalogue>, sessions: Sessions) -> Self {
        Self { worlds: Arc::new(Worlds::new(pool, catalogue)), sessions }
    }
}

#[tonic::async_trait]
impl Environment for Service {
    type ProcessStream = Responses<EnvironmentResponse>;

    async fn process(
        &self,
        requests: Request<Streaming<EnvironmentRequest>>,
    ) -> Result<Response<Self::ProcessStream>, Status> {
        let agent = Agent::new(Arc::clone(&self.worlds), self.sessions.clone());
        Ok(Response::new(self.sessions.begin(requests.into_inner(), agent)?))
    }
}

impl Dialogue for Agent {
    type Request = EnvironmentRequest;
    type Response = EnvironmentResponse;

    fn is_open(&self) -> bool {
        Agent::is_open(self)
    }

    fn answer(&mut self, request: Self::Request) -> impl Future<Output = Self::Response> + Send {
        Agent::answer(self, request)
    }
}
