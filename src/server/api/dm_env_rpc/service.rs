//! The gRPC service of `dm_env_rpc.v1`: one stream for each agent.

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

/// The path of calls that are streams of agents.
pub const ENDPOINT: &str = "/dm_env_rpc.v1.Environment/Process";

/// Serves worlds, which all streams share.
#[derive(Clone)]
pub struct DmEnvRpcService {
    worlds: Arc<Worlds>,
    sessions: Sessions,
    counts: Arc<RequestCounters>,
}

impl DmEnvRpcService {
    /// Makes a service without worlds. It records draws in the ledger, if there is one.
    pub fn new(pool: Arc<Pool>, catalogue: Arc<Catalogue>, sessions: Sessions, ledger: Option<Ledger>) -> Self {
        Self {
            worlds: Arc::new(Worlds::new(pool, catalogue, ledger)),
            sessions,
            counts: RequestCounters::new::<Agent>(),
        }
    }

    /// The same service with another view of the shutdown.
    pub fn with_drain(&self, drain: Drain) -> Self {
        Self { sessions: self.sessions.with_drain(drain), ..self.clone() }
    }

    /// The requests so far.
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
        let frames = raw_body::messages(&mut request)?;
        let agent = Agent::new(Arc::clone(&self.worlds), frames.bearer.clone(), self.sessions.clone());
        Ok(Response::new(self.sessions.begin(frames, agent, &self.counts)?))
    }
}
