//! Resumed sessions continue where they were.

use super::{begin, leased, not_resumed, replies, reply, resume, undisturbed};
use crate::{
    acting::game::{Game, PLAIN},
    common::{
        proxy::Proxy,
        server::{Actor, Server, Session, environment, open, step, until},
    },
};
use bytes::Bytes;
use perturb::proto::{Open, Step, act::Task};
use tonic::Code;

#[tokio::test]
async fn a_session_whose_connection_broke_goes_on_in_another() {
    let server = Server::start(&["--lease-seconds", "30"]);
    let expected = undisturbed(server.tcp(), 60).await;
    let proxy = Proxy::start(server.port(), |_| usize::MAX);
    let through = format!("http://{}", proxy.address());
    let (mut session, opened, environment) = begin(&through, 1).await;
    assert_eq!(opened.lease_seconds, 30);
    let actor = Actor::new(&environment, 4);
    let mut got = session.play(actor, 0, 20).await;
    proxy.cut();
    session.end().await;
    let (mut session, resumed) = resume(server.unix(), &opened.lease, 20).await;
    assert_eq!(resumed.last_reply, 20);
    got.extend(session.play(actor, 20, 60).await);
    assert!(got == expected, "other bytes");
}

#[tokio::test]
async fn lost_reply_is_sent_again_without_another_step() {
    let server = Server::start(&[]);
    let expected = undisturbed(server.tcp(), 30).await;
    let (mut session, opened, environment) = begin(server.tcp(), 1).await;
    let actor = Actor::new(&environment, 4);
    session.play(actor, 0, 10).await;
    for last in [9, 10, 9] {
        // Resumes as if the tenth reply had been lost.
        let resumed;
        (session, resumed) = resume(server.tcp(), &opened.lease, last).await;
        assert_eq!(resumed.last_reply, 10);
        assert!(replies(&mut session, 10 - last).await == expected[last as usize..10]);
    }
    assert!(session.play(actor, 10, 30).await == expected[10..], "other bytes");
}

#[tokio::test]
async fn replies_are_stored_for_all_unanswered_requests() {
    let server = Server::start(&[]);
    let expected = undisturbed(server.tcp(), 12).await;
    let (mut session, opened, environment) = begin(server.tcp(), 4).await;
    let actor = Actor::new(&environment, 4);
    session.play(actor, 0, 9).await;
    let refusal = session.refused(step(vec![1])).await;
    let (mut session, resumed) = resume(server.tcp(), &opened.lease, 6).await;
    assert_eq!(resumed.last_reply, 10, "nine steps and a refusal");
    assert!(replies(&mut session, 3).await == expected[6..9]);
    let again = replies(&mut session, 1).await.remove(0).response.unwrap();
    assert!(format!("{again:?}").contains(&format!("{:?}", refusal.1)), "{again:?}");
    let (code, words) = not_resumed(server.tcp(), &opened.lease, 5).await;
    assert!(
        code == Code::FailedPrecondition && words.contains("replies up to 6 are no longer stored"),
        "{code} {words}"
    );
    let (code, words) = not_resumed(server.tcp(), &opened.lease, 11).await;
    assert!(
        code == Code::OutOfRange && words.contains("last_reply is 11, but the session's last reply so far is 10"),
        "{code} {words}"
    );
    // Neither attempt affected the session, which continues on its stream.
    assert!(session.play(actor, 9, 12).await == expected[9..]);
}

#[tokio::test]
async fn requests_that_did_not_arrive_are_told_by_their_number() {
    let server = Server::start(&[]);
    let expected = undisturbed(server.tcp(), 4).await;
    let proxy = Proxy::start(server.port(), |_| usize::MAX);
    let (mut session, opened, environment) = begin(&format!("http://{}", proxy.address()), 4).await;
    let actor = Actor::new(&environment, 4);
    session.play(actor, 0, 2).await;
    proxy.silence();
    session.send(step(actor.actions(2))).await;
    session.send(step(actor.actions(3))).await;
    let (mut session, resumed) = resume(server.tcp(), &opened.lease, 2).await;
    assert_eq!(resumed.last_reply, 2, "two of four");
    assert!(session.play(actor, 2, 4).await == expected[2..]);
}

#[tokio::test]
async fn a_newer_stream_takes_over_from_one_that_looks_alive() {
    let server = Server::start(&[]);
    let (mut old, opened, environment) = begin(server.tcp(), 1).await;
    let actor = Actor::new(&environment, 4);
    old.play(actor, 0, 3).await;
    let (mut new, _) = resume(server.tcp(), &opened.lease, 3).await;
    let status = old.end().await;
    assert!(status.code() == Code::Aborted && status.message().contains("another stream has resumed"), "{status:?}");
    new.play(actor, 3, 6).await;
}

#[tokio::test]
async fn what_was_under_way_when_the_connection_broke_is_done() {
    let server = Server::start(&["--workers", "1"]);
    let game = Game { environment: "Pendulum", n: 64, ..PLAIN };
    let described = environment(server.tcp(), "Pendulum").await;
    let act = || game.act(&described, Task::Steps(2_000));
    let (mut twin, _) = Session::open(server.tcp(), game.open()).await;
    let expected = twin.ask(act()).await;
    let (session, opened) = Session::open(server.tcp(), Open { lease: 1, ..game.open() }).await;
    session.send(act()).await;
    // After this pause, the server either is answering the request or has not read it yet.
    tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    drop(session);
    let (mut session, resumed) = resume(server.tcp(), &opened.lease, 0).await;
    assert_eq!(resumed.last_reply, 1);
    let acted = replies(&mut session, 1).await.remove(0).response.unwrap();
    assert!(reply::<perturb::proto::Act>(acted) == expected, "other bytes");
}

#[tokio::test]
async fn refused_resume_leaves_the_stream_usable() {
    let server = Server::start(&[]);
    let (_session, opened, _) = begin(server.tcp(), 1).await;
    let mut wrong = opened.lease.to_vec();
    wrong[15] ^= 1;
    for lease in [wrong.into(), opened.lease.slice(..15), Bytes::new()] {
        let (code, words) = not_resumed(server.tcp(), &lease, 0).await;
        assert!(code == Code::NotFound && words.contains("no session of this server has this lease"), "{code} {words}");
    }
    let mut stream = Session::connect(server.tcp()).await;
    assert_eq!(stream.refused(perturb::proto::Resume::default()).await.0, Code::NotFound);
    let other = stream.ask(leased(1)).await;
    assert_ne!(other.lease, opened.lease);
    let again = stream.refused(perturb::proto::Resume { lease: opened.lease.clone(), last_reply: 0 }).await;
    assert!(again.0 == Code::FailedPrecondition && again.1.contains("on a session that is open"), "{again:?}");
    stream.ask(Step { actions: vec![0; 16].into() }).await;
    let (code, words) = Session::connect(server.tcp()).await.refused(leased(65)).await;
    assert!(code == Code::InvalidArgument && words.contains("open.lease is 65"), "{code} {words}");
}

#[tokio::test]
async fn a_session_without_a_lease_costs_and_keeps_nothing() {
    let server = Server::start(&["--max-envs", "4"]);
    let (session, opened) = Session::open(server.tcp(), open("CartPole", 4, 7)).await;
    assert!(opened.lease.is_empty() && opened.lease_seconds == 0);
    drop(session);
    until("its environments are free", async || {
        let mut session = Session::connect(server.tcp()).await;
        matches!(session.answer(open("CartPole", 4, 7)).await, perturb::proto::session_response::Response::Opened(_))
    })
    .await;
}
