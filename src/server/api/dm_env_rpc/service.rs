//! The gRPC service of `dm_env_rpc.v1`. Each agent has a stream of its own.

use super::{agent::Agent, worlds::Worlds};
use crate::{
    env::Catalogue,
    pool::Pool,
    proto::dm_env_rpc::v1::{EnvironmentRequest, EnvironmentResponse, environment_server::Environment},
    server::{
        audit::ledger::Ledger,
        session::{admission::Sessions, driver::Responses, instrumented::RequestCounters},
        shutdown::Drain,
        transport::raw_body,
    },
};
use std::sync::Arc;
use tonic::{Request, Response, Status, Streaming};

/// The path of the gRPC method whose calls are streams of agents.
pub const ENDPOINT: &str = "/dm_env_rpc.v1.Environment/Process";

/// The service of `dm_env_rpc.v1`. All its streams share the same worlds.
#[derive(Clone)]
pub struct DmEnvRpcService {
    worlds: Arc<Worlds>,
    sessions: Sessions,
    counts: Arc<RequestCounters>,
}

impl DmEnvRpcService {
    /// Makes the service. The service has no worlds yet, and records draws in `ledger`, if there is one.
    pub fn new(pool: Arc<Pool>, catalogue: Arc<Catalogue>, sessions: Sessions, ledger: Option<Ledger>) -> Self {
        Self {
            worlds: Arc::new(Worlds::new(pool, catalogue, ledger)),
            sessions,
            counts: RequestCounters::new::<Agent>(),
        }
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
impl Environment for DmEnvRpcService {
    type ProcessStream = Responses<EnvironmentResponse>;

    async fn process(
        &self,
        mut request: Request<Streaming<EnvironmentRequest>>,
    ) -> Result<Response<Self::ProcessStream>, Status> {
        let reader = raw_body::messages(&mut request)?;
        let agent = Agent::new(Arc::clone(&self.worlds), reader.bearer.clone(), self.sessions.clone());
        Ok(Response::new(self.sessions.begin(reader, agent, &self.counts)?))
    }
}
