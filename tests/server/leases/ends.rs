//! The ends of sessions with leases.

use super::{begin, leased, not_resumed, resume, undisturbed};
use crate::{
    common::{
        proxy::Proxy,
        server::{Actor, Server, Session, open, until},
    },
    metrics::Watched,
};
use perturb::proto::session_response::Response;
use std::time::{Duration, Instant};
use tonic::Code;

/// Returns whether a session with `envs` environments can be opened.
async fn has_room(server: &Server, envs: u32) -> bool {
    matches!(Session::connect(server.unix()).await.answer(open("CartPole", envs, 1)).await, Response::Opened(_))
}

#[tokio::test]
async fn it_keeps_its_place_until_the_lease_is_over() {
    let watched = Watched::start(&["--lease-seconds", "1", "--max-envs", "4"]);
    let server = &watched.server;
    let (session, opened, _) = begin(server.tcp(), 1).await;
    let start = Instant::now();
    drop(session);
    assert!(!has_room(server, 1).await);
    watched.until(r#"perturb_sessions_ended_total{protocol="perturb.v1",ending="lease_over"}"#, 1.0).await;
    assert!(start.elapsed() >= Duration::from_secs(1), "{:?}", start.elapsed());
    until("its environments are free", async || has_room(server, 4).await).await;
    assert_eq!(not_resumed(server.tcp(), &opened.lease, 0).await.0, Code::NotFound);
}

#[tokio::test]
async fn its_time_is_counted_from_each_loss() {
    let server = Server::start(&["--lease-seconds", "1"]);
    let (mut session, opened, _) = begin(server.tcp(), 1).await;
    for _ in 0..4 {
        drop(session);
        tokio::time::sleep(Duration::from_millis(400)).await;
        (session, _) = resume(server.tcp(), &opened.lease, 0).await;
    }
}

#[tokio::test]
async fn it_ends_at_once_when_its_client_closes_it() {
    let server = Server::start(&["--max-envs", "4"]);
    let (mut session, opened, environment) = begin(server.tcp(), 1).await;
    session.play(Actor::new(&environment, 4), 0, 3).await;
    session.close();
    assert_eq!(session.end().await.code(), Code::Ok);
    until("its environments are free", async || has_room(&server, 4).await).await;
    assert_eq!(not_resumed(server.tcp(), &opened.lease, 3).await.0, Code::NotFound);
    assert!(server.log().contains(r#"ending="closed""#), "{}", server.log());
}

#[tokio::test]
async fn silent_connection_is_lost_and_not_closed_by_its_client() {
    let watched = Watched::start(&["--keepalive-seconds", "1", "--lease-seconds", "60"]);
    let server = &watched.server;
    let proxy = Proxy::start(server.port(), |_| usize::MAX);
    let (mut session, opened, environment) = begin(&format!("http://{}", proxy.address()), 1).await;
    let (actor, expected) = (Actor::new(&environment, 4), undisturbed(server.tcp(), 6).await);
    session.play(actor, 0, 3).await;
    proxy.silence();
    watched.until("perturb_sessions_detached", 1.0).await;
    let (mut session, resumed) = resume(server.tcp(), &opened.lease, 3).await;
    assert_eq!(resumed.last_reply, 3);
    assert!(session.play(actor, 3, 6).await == expected[3..]);
}

#[tokio::test]
async fn a_server_without_leases_gives_none_and_says_so() {
    let server = Server::start(&["--lease-seconds", "0", "--max-envs", "4"]);
    let (session, opened) = Session::open(server.tcp(), leased(1)).await;
    assert!(opened.lease.is_empty() && opened.lease_seconds == 0);
    drop(session);
    until("its environments are free", async || has_room(&server, 4).await).await;
}

#[tokio::test]
async fn a_drain_waits_for_who_is_there_and_not_for_who_is_gone() {
    let mut server = Server::start(&["--grace-seconds", "60"]);
    let (gone, first, _) = begin(server.tcp(), 1).await;
    let (mut there, second, environment) = begin(server.tcp(), 1).await;
    drop(gone);
    there.play(Actor::new(&environment, 4), 0, 1).await;
    server.signal("TERM");
    until("it drains", async || server.log().contains("shutting down: no new sessions")).await;
    there.play(Actor::new(&environment, 4), 1, 20).await;
    for lease in [&first.lease, &second.lease] {
        let Err(status) = Session::start(&mut crate::common::server::client(server.tcp()).await).await else {
            panic!("a stream began, to take up {lease:?}");
        };
        assert_eq!(status.code(), Code::Unavailable);
    }
    let start = Instant::now();
    drop(there);
    assert!(server.ended().await.success());
    assert!(start.elapsed() < Duration::from_secs(20), "it waited {:?} for sessions without streams", start.elapsed());
    assert_eq!(server.log().matches(r#"ending="draining""#).count(), 2, "{}", server.log());
}

#[tokio::test]
async fn the_end_of_the_grace_period_is_told_in_its_stream() {
    let mut server = Server::start(&["--grace-seconds", "1"]);
    let (mut session, _, _) = begin(server.tcp(), 1).await;
    server.signal("TERM");
    let status = session.end().await;
    assert!(status.code() == Code::Unavailable && status.message().contains("shutting down"), "{status:?}");
    assert!(server.ended().await.success());
}

#[tokio::test]
async fn silence_ends_it_as_any_other() {
    let server = Server::start(&["--idle-seconds", "1"]);
    let (mut session, opened, _) = begin(server.tcp(), 1).await;
    let status = session.end().await;
    assert!(status.code() == Code::DeadlineExceeded && status.message().contains("idle for 1 s"), "{status:?}");
    assert_eq!(not_resumed(server.tcp(), &opened.lease, 0).await.0, Code::NotFound);
}
