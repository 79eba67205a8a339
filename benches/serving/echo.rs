//! An echo server, which measures the cost of a round trip without environments.

use super::Failure;
use bytes::Bytes;
use perturb::proto::{
    self, SessionRequest, SessionResponse,
    perturb_server::{Perturb, PerturbServer},
    session_request::Request as RequestKind,
    session_response::Response as ResponseKind,
};
use std::{path::Path, pin::Pin};
use tokio::net::UnixListener;
use tokio_stream::{Stream, StreamExt, wrappers::UnixListenerStream};
use tonic::{Request, Response, Status, Streaming, transport::Server};

/// Answers every step with a prepared reply that has the size of a real reply.
struct Echo;

#[tonic::async_trait]
impl Perturb for Echo {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<SessionResponse, Status>> + Send>>;

    async fn list_environments(
        &self,
        _: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        Err(Status::unimplemented("this is an echo"))
    }

    async fn session(
        &self,
        requests: Request<Streaming<SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let reply = proto::Stepped {
            observations: Bytes::from(vec![0; 256 * 16]),
            rewards: Bytes::from(vec![0; 256 * 4]),
            terminated: Bytes::from(vec![0; 256]),
            truncated: Bytes::from(vec![0; 256]),
            ..Default::default()
        };
        let responses = requests.into_inner().map(move |request| {
            let response = match request?.request {
                Some(RequestKind::Open(_)) => ResponseKind::Opened(proto::Opened::default()),
                _ => ResponseKind::Stepped(reply.clone()),
            };
            Ok(SessionResponse { response: Some(response) })
        });
        Ok(Response::new(Box::pin(responses)))
    }
}

/// Serves on the Unix socket until the process is killed.
pub(crate) async fn serve(socket: &Path) -> Result<(), Failure> {
    let listener = UnixListener::bind(socket)?;
    println!("listening");
    Ok(Server::builder()
        .add_service(PerturbServer::new(Echo))
        .serve_with_incoming(UnixListenerStream::new(listener))
        .await?)
}
