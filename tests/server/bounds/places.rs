//! Limits of the number of sessions and connections, and timeouts of clients that occupy a session or connection
//! without using it.

use super::client::{Connection, SESSION};
use crate::common::server::{Server, Session, client, command, open, until, within};
use std::{
    io::{Read, Write},
    net::TcpStream,
    os::unix::process::CommandExt,
    time::{Duration, Instant},
};
use tonic::Code;

#[tokio::test]
async fn half_a_preface_is_closed_in_time() {
    let server = Server::start(&["--handshake-seconds", "5"]);
    for part in [&b""[..], b"PRI * HTTP/2.0\r\n"] {
        let mut half = TcpStream::connect(server.port()).unwrap();
        half.write_all(part).unwrap();
        half.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let closed = tokio::task::spawn_blocking(move || half.read_to_end(&mut Vec::new())).await.unwrap();
        // Checks that the connection was closed or reset, and that the read did not time out.
        let waited = closed.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock);
        assert!(!waited, "{closed:?}");
    }
    // A connection that has finished its handshake is kept even without calls.
    let mut idle = client(server.tcp()).await;
    tokio::time::sleep(Duration::from_secs(7)).await;
    let mut session = Session::start(&mut idle).await.unwrap();
    session.ask(open("CartPole", 1, 1)).await;
}

#[tokio::test]
async fn sessions_that_are_never_opened_give_their_places_back() {
    let server = Server::start(&["--handshake-seconds", "5", "--max-sessions", "100"]);
    let (mut opened, _) = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    let mut connection = Connection::new(server.port(), 1 << 16).await;
    let mut calls = Vec::new();
    for _ in 0..99 {
        calls.push(connection.call(SESSION).await.unwrap());
    }
    let mut other = client(server.unix()).await;
    until("there is a place again", async || Session::start(&mut other).await.is_ok()).await;
    let (code, message) = calls[0].status().await.unwrap();
    assert_eq!(code, Code::DeadlineExceeded as i32, "{message}");
    assert!(message.contains("5 s"), "{message}");
    opened.step(vec![0; 4].into()).await;
}

/// Each stream's first reply waits for a flow-control window that the client never opens.
#[tokio::test]
async fn session_with_unread_first_reply_gives_its_place_back() {
    let server = Server::start(&["--handshake-seconds", "3", "--max-sessions", "20"]);
    let mut connection = Connection::new(server.port(), 0).await;
    let mut calls = Vec::new();
    for _ in 0..20 {
        let mut call = connection.call(SESSION).await.unwrap();
        assert!(call.send_message(b"").await);
        calls.push(call);
    }
    let mut other = client(server.unix()).await;
    until("all places are taken", async || Session::start(&mut other).await.is_err()).await;
    until("there is a place again", async || Session::start(&mut other).await.is_ok()).await;
    until("the connection is closed", async || connection.is_closed()).await;
}

#[tokio::test]
async fn who_is_refused_again_and_again_has_not_opened_a_session() {
    let server = Server::start(&["--handshake-seconds", "3"]);
    let mut session = Session::connect(server.tcp()).await;
    let start = Instant::now();
    let status = loop {
        session.send(open("Nowhere", 1, 1)).await;
        match session.receive().await {
            Ok(Some(_)) => tokio::time::sleep(Duration::from_millis(500)).await,
            Ok(None) => panic!("it ends with a status"),
            Err(status) => break status,
        }
        assert!(start.elapsed() < Duration::from_secs(60), "it is kept");
    };
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
    assert!(start.elapsed() >= Duration::from_secs(3));
}

/// The client always sends its next request before the previous one is refused.
#[tokio::test]
async fn refusals_without_a_pause_do_not_extend_the_handshake() {
    let server = Server::start(&["--handshake-seconds", "2"]);
    let mut session = Session::connect(server.tcp()).await;
    let sender = session.sender();
    let wrong = || perturb::proto::SessionRequest { request: Some(open("Nowhere", 1, 1).into()) };
    tokio::spawn(async move { while sender.send(wrong()).await.is_ok() {} });
    let start = Instant::now();
    let status = loop {
        if let Err(status) = session.receive().await {
            break status;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "it is kept");
    };
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
}

#[tokio::test]
async fn a_peer_has_no_more_sessions_and_connections_than_its_quota() {
    let server = Server::start(&["--max-peer-sessions", "2"]);
    let mut one = client(server.tcp()).await;
    let (mut first, _second) = (Session::start(&mut one).await.unwrap(), Session::connect(server.tcp()).await);
    first.ask(open("CartPole", 1, 1)).await;
    let status = Session::start(&mut one).await.err().expect("a third session is refused");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    assert!(status.message().contains("all of the 2 sessions"), "{status:?}");
    // A client on the Unix socket is another peer.
    let (mut other, _) = Session::open(server.unix(), open("CartPole", 1, 1)).await;
    // A peer may have some more connections than sessions; further connections are closed.
    let mut connections: Vec<TcpStream> = (0..40).map(|_| TcpStream::connect(server.port()).unwrap()).collect();
    let mut last = connections.pop().unwrap();
    last.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    let closed = tokio::task::spawn_blocking(move || last.read(&mut [0])).await.unwrap();
    assert!(
        matches!(closed, Ok(0)) || closed.as_ref().is_err_and(|e| e.kind() != std::io::ErrorKind::WouldBlock),
        "{closed:?}"
    );
    first.step(vec![0; 4].into()).await;
    other.step(vec![0; 4].into()).await;
}

#[tokio::test]
async fn connections_beyond_the_soft_descriptor_limit_are_served() {
    let mut limited = std::process::Command::new("sh");
    limited.arg("-c").arg("ulimit -S -n 64; exec \"$@\"").arg("sh").arg(command().get_program());
    limited.args(["--listen", "tcp://127.0.0.1:0"]).arg0("sh");
    let server = Server::spawn(limited, tempfile::tempdir().unwrap(), 1);
    let mut sessions = Vec::new();
    for seed in 0..100 {
        sessions.push(within(Session::open(server.tcp(), open("CartPole", 1, seed))).await);
    }
}

/// The environment variable with the number of seconds for which the test below steps. `make load-test` sets it.
#[cfg(feature = "mujoco")]
const SECONDS: &str = "PERTURB_TEST_FULL_SERVER_SECONDS";

#[cfg(feature = "mujoco")]
#[tokio::test]
async fn hoppers_can_fill_all_places_and_one_more_is_refused() {
    use crate::common::server::{step, stepped};
    const SESSIONS: usize = 1024;
    let server = Server::start(&[]);
    let mut sessions = Vec::new();
    let mut connection = client(server.tcp()).await;
    for seed in 0..SESSIONS {
        if seed % 64 == 0 {
            connection = client(server.tcp()).await;
        }
        let mut session = Session::start(&mut connection).await.unwrap();
        session.ask(open("Hopper", 16, seed as u64)).await;
        sessions.push(session);
    }
    let mut one_more = client(server.unix()).await;
    let asked = Instant::now();
    let status = Session::start(&mut one_more).await.err().expect("one more is refused");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    println!("refused after {:?}, {} MB", asked.elapsed(), server.memory() >> 20);
    let seconds = std::env::var(SECONDS).map_or(0, |seconds| seconds.parse().unwrap());
    let (start, mut rounds, mut times) = (Instant::now(), 0, Vec::new());
    while rounds < 3 || start.elapsed() < Duration::from_secs(seconds) {
        // All sessions step at once, so a session's waiting time is the time that the server takes for all of them.
        let sent = Instant::now();
        for session in &sessions {
            session.send(step(vec![0; 4 * 3 * 16])).await;
        }
        for session in &mut sessions {
            stepped(&session.receive().await.unwrap().unwrap());
            times.push(sent.elapsed());
        }
        rounds += 1;
    }
    times.sort_unstable();
    let at = |percent: usize| times[(times.len() - 1) * percent / 100];
    println!("{rounds} steps of all: median {:?}, p99 {:?}, {} MB", at(50), at(99), server.peak_memory() >> 20);
}
