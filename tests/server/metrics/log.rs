//! The access log.

use crate::common::server::{Server, Session, client, open, until};
use std::time::Instant;

const LINE: &str = "a session ended";

async fn lines(server: &Server, count: usize) -> Vec<String> {
    until("sessions have ended", async || server.log().matches(LINE).count() >= count).await;
    server.log().lines().filter(|line| line.contains(LINE)).map(str::to_owned).collect()
}

#[tokio::test]
async fn a_session_that_ends_has_a_line_with_what_it_came_to() {
    let server = Server::start(&["--idle-seconds", "1"]);
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 4, 1)).await;
    session.step(vec![0; 16].into()).await;
    session.close();
    session.end().await;
    let line = lines(&server, 1).await.pop().unwrap();
    for part in [
        "INFO perturb::access",
        "peer=127.0.0.1",
        r#"protocol="perturb.v1""#,
        r#"environment="CartPole""#,
        "envs=4",
        "steps=4",
        "seconds=",
        r#"ending="closed""#,
    ] {
        assert!(line.contains(part), "no {part} in {line}");
    }
    assert!(!line.contains("token="), "{line}");

    let (idle, _) = Session::open(server.unix(), open("Pendulum", 1, 1)).await;
    let line = lines(&server, 2).await.pop().unwrap();
    assert!(line.contains("peer=user ") && line.contains(r#"ending="idle""#), "{line}");
    drop(idle);
    drop(Session::open(server.tcp(), open("Pendulum", 1, 1)).await);
    let line = lines(&server, 3).await.pop().unwrap();
    assert!(line.contains(r#"ending="gone""#), "{line}");
}

#[tokio::test]
async fn access_log_is_bounded_and_says_what_it_left_out() {
    const SESSIONS: usize = 400;
    let server = Server::start(&[]);
    let start = Instant::now();
    let mut connection = client(server.tcp()).await;
    for _ in 0..SESSIONS {
        Session::start(&mut connection).await.unwrap().close();
    }
    let counts = || {
        let log = server.log();
        let left_out = |line: &str| line.split_once("left_out=").map(|(_, n)| n.trim().parse::<usize>().unwrap());
        (log.matches(LINE).count(), log.lines().filter_map(left_out).sum::<usize>())
    };
    until("all sessions are logged or counted", async || counts().0 + counts().1 == SESSIONS).await;
    let (lines, left_out) = counts();
    let windows = start.elapsed().as_secs() as usize + 1;
    assert!(left_out > 0 && lines <= 20 * windows, "{lines} lines in {windows} s, {left_out} left out");
}
