//! The Rust client of this repository, over connections that break.

use super::{leased, undisturbed};
use crate::common::{
    proxy::Proxy,
    server::{Actor, Server, environment, mixed, open, within},
};
use perturb::proto::{SessionResponse, Step, session_response::Response};
use perturb_protocol::{ClientError, Connection, Stream};
use rstest::rstest;
use std::time::{Duration, Instant};

const STEPS: u64 = 400;

/// Connects through a proxy that cuts connection number n after `most(n)` bytes.
async fn connect(server: &Server, most: impl Fn(usize) -> usize + Send + 'static) -> (Proxy, Connection) {
    let proxy = Proxy::start(server.port(), most);
    let connection = within(Connection::open(&format!("http://{}", proxy.address()).parse().unwrap())).await.unwrap();
    (proxy, connection)
}

/// Takes steps, some of them ahead of the replies.
async fn play(
    stream: &mut Stream,
    actor: Actor<'_>,
    steps: u64,
    ahead: u64,
) -> Result<Vec<SessionResponse>, ClientError> {
    let (mut sent, mut replies) = (0, Vec::new());
    for t in 0..steps {
        while sent < steps && sent < t + ahead {
            within(stream.send(Step { actions: actor.actions(sent) })).await?;
            sent += 1;
        }
        let response = Some(Response::Stepped(within(stream.receive::<Step>()).await?));
        replies.push(SessionResponse { response });
    }
    Ok(replies)
}

#[rstest]
#[case::one_by_one(1)]
#[case::ahead(3)]
#[tokio::test]
async fn session_over_a_breaking_line_has_the_same_bytes(#[case] ahead: u32) {
    let server = Server::start(&[]);
    let expected = undisturbed(server.tcp(), STEPS).await;
    let described = environment(server.tcp(), "CartPole").await;
    for seed in 0..4 {
        // The first connection must last until the session is open. Some of the other connections break before they
        // resume the session.
        let most = move |number| if number == 0 { 20_000 } else { mixed(mixed(seed) ^ number as u64) as usize % 6_000 };
        let (proxy, connection) = connect(&server, most).await;
        let (mut stream, _) = within(Stream::open(&connection, leased(ahead))).await.unwrap();
        let got = play(&mut stream, Actor::new(&described, 4), STEPS, ahead.into()).await.unwrap();
        assert!(got == expected, "seed {seed}: other bytes");
        assert!(proxy.cuts() > 5, "seed {seed}: {} cuts", proxy.cuts());
    }
}

#[tokio::test]
async fn a_session_that_is_closed_makes_room_at_once() {
    let server = Server::start(&["--max-envs", "4"]);
    let connection = within(Connection::open(&server.tcp().parse().unwrap())).await.unwrap();
    for _ in 0..3 {
        let (mut stream, _) = within(Stream::open(&connection, leased(1))).await.unwrap();
        within(stream.ask(Step { actions: vec![0; 16].into() })).await.unwrap();
        within(stream.close()).await;
    }
}

#[tokio::test]
async fn without_a_lease_a_broken_line_is_a_lost_server() {
    let server = Server::start(&[]);
    let described = environment(server.tcp(), "CartPole").await;
    let (proxy, connection) = connect(&server, |_| usize::MAX).await;
    let (mut stream, _) = within(Stream::open(&connection, open("CartPole", 4, 7))).await.unwrap();
    proxy.cut();
    let error = play(&mut stream, Actor::new(&described, 4), 1, 1).await.unwrap_err();
    assert!(error.is_absence(), "{error}");
}

#[tokio::test]
async fn a_session_whose_lease_is_over_is_a_lost_server() {
    let server = Server::start(&["--lease-seconds", "1"]);
    let described = environment(server.tcp(), "CartPole").await;
    let (proxy, connection) = connect(&server, |_| usize::MAX).await;
    let (mut stream, _) = within(Stream::open(&connection, leased(1))).await.unwrap();
    proxy.cut();
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let error = play(&mut stream, Actor::new(&described, 4), 1, 1).await.unwrap_err();
    assert!(error.is_absence(), "{error}");
}

#[tokio::test]
async fn gone_server_is_not_waited_for_until_the_lease_ends() {
    let server = Server::start(&[]);
    let described = environment(server.tcp(), "CartPole").await;
    let connection = within(Connection::open(&server.tcp().parse().unwrap())).await.unwrap();
    let (mut stream, _) = within(Stream::open(&connection, leased(1))).await.unwrap();
    drop(server);
    let start = Instant::now();
    let error = play(&mut stream, Actor::new(&described, 4), 1, 1).await.unwrap_err();
    assert!(error.is_absence(), "{error}");
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
}
