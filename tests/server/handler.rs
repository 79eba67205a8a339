//! The embedded server: the session handler without gRPC, called with requests.

use crate::{
    acting::game::PLAIN,
    common::server::{Server, Session, open, step},
};
use bytes::Bytes;
use perturb::{
    proto::{
        Open, Render, Reset, Restore, SavePlayer, SessionRequest, Snapshot, act, session_request::Request,
        session_response::Response,
    },
    server::{
        embedded::{EmbeddedServer, EmbeddedSession},
        limits::MAX_BYTES_BEFORE_OPEN,
    },
    tasks,
};

async fn answer(session: &mut EmbeddedSession, request: impl Into<Request>) -> Response {
    let request = SessionRequest { request: Some(request.into()) };
    session.answer(request).await.unwrap().response.unwrap()
}

#[tokio::test]
async fn embedded_server_gives_the_responses_of_a_server() {
    let server = Server::start(&[]);
    let mut session = Session::connect(server.unix()).await;
    let mut own = EmbeddedServer::start(tasks::catalogue()).unwrap().session();
    let requests: [Request; 8] = [
        step(vec![0; 4]), // refused, because it comes before open
        open("CartPole", 8, 7).into(),
        step(vec![0; 32]),
        Render { slot: 3, width: 32, height: 32 }.into(),
        Snapshot { mask: vec![1, 0, 0, 0, 0, 0, 0, 1].into() }.into(),
        Reset { seeds: vec![5; 8], ..Reset::default() }.into(),
        Reset { seeds: vec![5; 2000], ..Reset::default() }.into(), // more entries than are allowed
        step(vec![0; 3]),                                          // of a wrong length
    ];
    for request in requests {
        assert_eq!(answer(&mut own, request.clone()).await, session.answer(request).await);
    }
}

#[tokio::test]
async fn embedded_server_plays_policies_and_restores_as_a_server() {
    let server = Server::start(&[]);
    let (mut session, environment) = PLAIN.session(&server).await;
    let mut own = EmbeddedServer::start(tasks::catalogue()).unwrap().session();
    answer(&mut own, PLAIN.open()).await;
    let saved = match answer(&mut own, Snapshot::default()).await {
        Response::Snapshot(saved) => saved.snapshots,
        other => panic!("{other:?}"),
    };
    let requests: [Request; 5] = [
        PLAIN.act(&environment, act::Task::Steps(40)).into(),
        SavePlayer {}.into(),
        Restore { snapshots: saved, ..Restore::default() }.into(),
        Restore { snapshots: vec![Bytes::from_static(b"none"); PLAIN.n], ..Restore::default() }.into(),
        step(vec![0; 4 * PLAIN.n]),
    ];
    for request in requests {
        assert_eq!(answer(&mut own, request.clone()).await, session.answer(request).await);
    }
}

#[tokio::test]
async fn request_that_is_too_large_ends_an_embedded_session() {
    let server = Server::start(&[]);
    let mut session = Session::connect(server.unix()).await;
    let embedded = EmbeddedServer::start(tasks::catalogue()).unwrap();
    let long = Open { environment: "a".repeat(MAX_BYTES_BEFORE_OPEN), ..Open::default() };
    session.send(long.clone()).await;
    let ended = embedded.session().answer(SessionRequest { request: Some(long.into()) }).await.unwrap_err();
    let expected = session.end().await;
    assert_eq!((ended.code(), ended.message()), (expected.code(), expected.message()));
}
