//! Limits of leases: number, memory, tokens.

use super::{begin, leased, not_resumed, replies, resume};
use crate::{
    common::server::{Actor, Server, Session, client, open, until},
    metrics::Watched,
};
use perturb::proto::{Open, Render, Resume};
use tonic::Code;

const ANN: &str = "correct-horse-battery";
const BOB: &str = "staple-correct-horse";

#[tokio::test]
async fn a_full_server_takes_up_its_sessions_and_nothing_else() {
    let server = Server::start(&["--max-sessions", "1"]);
    let (session, opened, environment) = begin(server.tcp(), 1).await;
    let mut stranger = Session::connect(server.tcp()).await;
    stranger.send(open("CartPole", 1, 1)).await;
    let status = stranger.end().await;
    assert!(status.code() == Code::ResourceExhausted && status.message().contains("1 sessions"), "{status:?}");
    drop(session);
    let (mut session, _) = resume(server.tcp(), &opened.lease, 0).await;
    session.play(Actor::new(&environment, 4), 0, 3).await;
    let mut guess = Session::connect(server.tcp()).await;
    guess.send(Resume { lease: vec![0; 16].into(), last_reply: 0 }).await;
    assert_eq!(guess.end().await.code(), Code::NotFound, "a wrong guess has no second one");
    // For each lease there is room for one more stream, until it sends its first request.
    let _waits = Session::connect(server.tcp()).await;
    let refused = Session::start(&mut client(server.tcp()).await).await.err().expect("no more room");
    assert_eq!(refused.code(), Code::ResourceExhausted);
}

#[tokio::test]
async fn session_is_resumed_only_with_its_own_token() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("tokens.toml");
    let entry = |name, token| format!("[[token]]\nname = \"{name}\"\ntoken = \"{token}\"\nmax_sessions = 1\n");
    std::fs::write(&file, entry("ann", ANN) + &entry("bob", BOB)).unwrap();
    let watched = Watched::start(&["--tokens", file.to_str().unwrap()]);
    let server = &watched.server;
    let mut connection = client(server.tcp()).await;
    let mut session = Session::show(&mut connection, Some(ANN)).await.unwrap();
    let opened = session.ask(leased(1)).await;
    drop(session);
    let ask = || Resume { lease: opened.lease.clone(), last_reply: 0 };
    let (code, words) = Session::show(&mut connection, Some(BOB)).await.unwrap().refused(ask()).await;
    assert!(code == Code::PermissionDenied && words.contains("opened with another token"), "{code} {words}");
    assert_eq!(not_resumed(server.unix(), &opened.lease, 0).await.0, Code::PermissionDenied, "a socket's has none");
    let mut another = Session::show(&mut connection, Some(ANN)).await.unwrap();
    another.send(leased(1)).await;
    assert_eq!(another.end().await.code(), Code::ResourceExhausted, "it still has its one session");
    Session::show(&mut connection, Some(ANN)).await.unwrap().ask(ask()).await;
    // A session without a stream also ends when its token is revoked.
    std::fs::write(&file, entry("bob", BOB)).unwrap();
    until("it has ended", async || server.log().contains(r#"ending="revoked_token""#)).await;
    watched.until(r#"perturb_refusals_total{code="UNAUTHENTICATED",reason="revoked_token"}"#, 1.0).await;
}

#[tokio::test]
async fn stored_replies_are_budgeted_and_dropped_for_room() {
    const PICTURE: u64 = 3 * 512 * 512;
    let watched = Watched::start(&["--max-memory", "4000000"]);
    let address = watched.server.unix();
    let (mut session, opened) = Session::open(address, Open { lease: 64, ..open("CartPole", 1, 1) }).await;
    let empty = watched.page().number("perturb_in_flight_bytes");
    let picture = || Render { slot: 0, width: 512, height: 512 };
    session.ask(picture()).await;
    // The budget counts the stored picture and the overhead of a reply. The memory for sending the picture is already
    // free.
    let kept = empty + PICTURE as f64;
    until("one is kept", async || (kept..kept + 2e3).contains(&watched.page().number("perturb_in_flight_bytes"))).await;
    for _ in 1..20 {
        session.ask(picture()).await;
    }
    let page = watched.page();
    assert!(page.number("perturb_in_flight_bytes") <= 4e6, "{}", page.text);
    assert_eq!(not_resumed(address, &opened.lease, 0).await.0, Code::FailedPrecondition);
    let (mut session, resumed) = resume(address, &opened.lease, 19).await;
    assert_eq!(resumed.last_reply, 20);
    replies(&mut session, 1).await;
    drop(session);
    watched.until("perturb_sessions_detached", 1.0).await;
}

#[tokio::test]
async fn a_session_keeps_little_however_much_room_there_is() {
    let watched = Watched::start(&[]);
    let (mut session, _) = Session::open(watched.server.unix(), Open { lease: 64, ..open("CartPole", 1, 1) }).await;
    for _ in 0..20 {
        session.ask(Render { slot: 0, width: 512, height: 512 }).await;
        let page = watched.page();
        assert!(page.number("perturb_in_flight_bytes") < 6e6, "{}", page.text);
    }
}

#[tokio::test]
async fn metrics_count_detached_and_resumed_sessions() {
    let watched = Watched::start(&[]);
    let (session, opened, _) = begin(watched.server.tcp(), 1).await;
    assert_eq!(watched.page().number("perturb_sessions_detached"), 0.0);
    drop(session);
    watched.until("perturb_sessions_detached", 1.0).await;
    let page = watched.page();
    assert_eq!(["perturb_sessions", "perturb_environments"].map(|series| page.number(series)), [1.0, 4.0]);
    let (mut session, _) = resume(watched.server.tcp(), &opened.lease, 0).await;
    watched.until("perturb_sessions_detached", 0.0).await;
    assert_eq!(watched.page().number("perturb_sessions_resumed_total"), 1.0);
    let done = r#"perturb_requests_total{protocol="perturb.v1",kind="resume",outcome="done"}"#;
    assert_eq!(watched.page().number(done), 1.0);
    watched.until("perturb_sessions", 1.0).await;
    session.close();
    session.end().await;
    watched.until("perturb_sessions", 0.0).await;
    let log = watched.server.log();
    assert_eq!(log.matches("a session ended").count(), 1, "a stream that moved on is no session:\n{log}");
    assert!(log.contains(r#"resumed=1 ending="closed""#), "{log}");
}
