//! Several transport threads: connections are spread over them, and the server's guarantees hold across them.

use crate::{
    common::server::{Actor, Server, Session, client, environment, open},
    guarded::entry,
    metrics::Watched,
};
use perturb::proto::{Open, Resume};
use tonic::Code;

const TOKEN: &str = "correct-horse-battery";
const TWO: [&str; 2] = ["--transport-threads", "2"];

/// Returns the metric series of a thread's number of connections.
fn connections(thread: usize) -> String {
    format!("perturb_transport_connections{{thread=\"{thread}\"}}")
}

/// Opens sessions, each on a new connection, alternately over TCP and the Unix socket.
async fn sessions(server: &Server, count: usize) -> Vec<Session> {
    let mut sessions = Vec::new();
    for place in 0..count {
        let address = if place.is_multiple_of(2) { server.tcp() } else { server.unix() };
        sessions.push(Session::open(address, open("CartPole", 2, 1)).await.0);
    }
    sessions
}

#[tokio::test]
async fn connections_are_spread_over_the_threads() {
    let watched = Watched::start(&TWO);
    let mut sessions = sessions(&watched.server, 8).await;
    for thread in [0, 1] {
        watched.until(&connections(thread), 4.0).await;
    }
    for session in &mut sessions {
        session.step(vec![0; 8].into()).await;
    }
    drop(sessions);
    for thread in [0, 1] {
        watched.until(&connections(thread), 0.0).await;
    }
}

#[tokio::test]
async fn a_session_is_resumed_from_a_connection_on_another_thread() {
    const STEPS: u64 = 60;
    let watched = Watched::start(&TWO);
    let address = watched.server.tcp();
    let environment = environment(address, "CartPole").await;
    let actor = Actor::new(&environment, 4);
    let leased = Open { lease: 1, ..open("CartPole", 4, 7) };
    let (mut undisturbed, _) = Session::open(address, open("CartPole", 4, 7)).await;
    let expected = undisturbed.play(actor, 0, STEPS).await;
    drop(undisturbed);
    for thread in [0, 1] {
        watched.until(&connections(thread), 0.0).await;
    }
    let (mut session, opened) = Session::open(address, leased).await;
    let mut got = session.play(actor, 0, STEPS / 2).await;
    let mut other = Session::connect(address).await;
    for thread in [0, 1] {
        watched.until(&connections(thread), 1.0).await;
    }
    let resumed = other.ask(Resume { lease: opened.lease, last_reply: STEPS / 2 }).await;
    assert_eq!(resumed.last_reply, STEPS / 2);
    assert_eq!(session.end().await.code(), Code::Aborted, "the first stream has lost it");
    drop(session);
    got.extend(other.play(actor, STEPS / 2, STEPS).await);
    assert!(got == expected, "other bytes");
    other.close();
    assert_eq!(other.end().await.code(), Code::Ok);
    watched.until("perturb_sessions", 0.0).await;
}

#[tokio::test]
async fn limits_of_sessions_hold_across_threads() {
    let watched = Watched::start(&[&TWO[..], &["--max-sessions", "5"]].concat());
    let mut taken = sessions(&watched.server, 5).await;
    for address in [watched.server.tcp(), watched.server.unix(), watched.server.tcp()] {
        let refused = Session::start(&mut client(address).await).await.err().expect("the server is full");
        assert_eq!(refused.code(), Code::ResourceExhausted, "{refused:?}");
    }
    drop(taken.pop());
    watched.until("perturb_sessions", 4.0).await;
    taken.extend(sessions(&watched.server, 1).await);
}

#[tokio::test]
async fn quotas_of_a_token_hold_across_threads() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("tokens.toml");
    std::fs::write(&file, entry("ann", TOKEN, "max_envs = 6")).unwrap();
    let server = Server::start(&[&TWO[..], &["--tokens", file.to_str().unwrap()]].concat());
    let mut sessions = Vec::new();
    for _ in 0..4 {
        let mut client = client(server.tcp()).await;
        sessions.push(Session::show(&mut client, Some(TOKEN)).await.unwrap());
    }
    for session in &mut sessions[..3] {
        session.ask(open("CartPole", 2, 1)).await;
    }
    let (code, words) = sessions[3].refused(open("CartPole", 1, 1)).await;
    assert_eq!(code, Code::ResourceExhausted, "{words}");
}
