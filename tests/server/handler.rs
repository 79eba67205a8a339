//! The handler of a session without gRPC: a request in, a reply out.

use crate::common::server::{Server, Session, open, step};
use perturb::{
    config::Config,
    pool::Pool,
    proto::{Render, Reset, SessionRequest, SessionResponse, Snapshot, session_request::Request},
    render::Renderer,
    server::{
        self,
        api::perturb_v1::session::{ServerContext, Session as Handler},
        session::{
            handler::SessionHandler,
            lease::{LeaseCounters, Leases},
        },
        transport::budget::Budget,
    },
    tasks,
};
use std::{sync::Arc, time::Duration};

fn handler() -> Handler {
    let catalogue = tasks::catalogue();
    let listing = server::listing(&catalogue, &Config::default()).unwrap();
    let shared = ServerContext {
        pool: Arc::new(Pool::new(2, 100).unwrap()),
        catalogue: Arc::new(catalogue),
        listing,
        renderer: Renderer::new(),
        ledger: None,
        leases: Leases::new(Duration::ZERO, LeaseCounters::default()),
    };
    Handler::new(Arc::new(shared), None, Budget::new(1 << 30))
}

#[tokio::test]
async fn handler_without_grpc_gives_the_responses_of_a_server() {
    let server = Server::start(&[]);
    let mut session = Session::connect(server.unix()).await;
    let mut handler = handler();
    let requests: [Request; 7] = [
        step(vec![0; 4]), // before open, which is refused
        open("CartPole", 8, 7).into(),
        step(vec![0; 32]),
        Render { slot: 3, width: 32, height: 32 }.into(),
        Snapshot { mask: vec![1, 0, 0, 0, 0, 0, 0, 1].into() }.into(),
        Reset { seeds: vec![5; 8], ..Reset::default() }.into(),
        step(vec![0; 3]), // of a wrong length
    ];
    for request in requests {
        let reply = handler.answer(SessionRequest { request: Some(request.clone()) }).await;
        let own = reply.map_or_else(Handler::error_response, |reply| reply.response);
        let served = SessionResponse { response: Some(session.answer(request).await) };
        assert_eq!(own, served);
    }
}
