//! Texts of clients in error messages and in the log: they are shortened and contain no control characters.

use crate::{
    common::server::{Server, Session, open, parameters, within},
    dm_env_rpc::client::{self as worlds, Agent},
    guarded::entry,
};
use perturb::proto::{Open, Reset, Restore, session_request::Request};
use std::{io::Write, net::TcpStream};
use tonic::Code;

/// The maximum length of an error message: a sentence or two, and a hundred characters of the client's text.
const LONGEST: usize = 1000;
/// The maximum length of a line of the log, which contains the error message and its context.
const LONGEST_LINE: usize = 2 * LONGEST;

/// Returns a text that sets colours and a terminal's title, returns to the line's start, rings the bell, changes the
/// writing direction, and has 20 kB.
fn evil() -> String {
    format!("evil\x1b[31m\x1b]0;title\x07\r\n\u{202e}\0{}", "e".repeat(20_000))
}

#[track_caller]
fn is_harmless(words: &str) {
    assert!(words.len() < LONGEST, "{} bytes: {words}", words.len());
    assert!(!words.contains(|letter: char| letter.is_control() || letter == '\u{202e}'), "{words:?}");
}

#[tokio::test]
async fn clients_texts_are_shortened_and_escaped() {
    let directory = tempfile::tempdir().unwrap();
    let tokens = directory.path().join("tokens.toml");
    std::fs::write(&tokens, entry("ann", "correct-horse-battery", "")).unwrap();
    let server = Server::start(&["--log", "trace,h2=info", "--tokens", tokens.to_str().unwrap()]);
    let (mut session, evil) = (Session::connect(server.unix()).await, evil());
    let named = |name: &str| parameters(&[(name, &[(1.0, 1.0)])]);
    let requests: [Request; 2] = [
        Request::Open(Open { environment: evil.clone(), ..open("CartPole", 1, 1) }),
        Request::Open(Open { parameters: named(&evil), ..open("CartPole", 1, 1) }),
    ];
    for request in requests {
        is_harmless(&session.refused(request).await.1);
    }
    session.ask(open("CartPole", 1, 1)).await;
    is_harmless(&session.refused(Reset { parameters: named(&evil), ..Reset::default() }).await.1);
    let snapshot = session.snapshot(&[]).await.remove(0);
    let at = snapshot.windows(8).position(|window| window == b"CartPole").unwrap();
    let mut forged = snapshot[..snapshot.len() - 4].to_vec();
    forged[at..at + 8].copy_from_slice(b"\x1b[31m\r\n\x07");
    let sealed = [&forged[..], &crc32c::crc32c(&forged).to_le_bytes()].concat();
    is_harmless(&session.refused(Restore { snapshots: vec![sealed.into()], ..Restore::default() }).await.1);

    let mut agent = Agent::connect(server.unix()).await;
    let world_name = || ("world_name", worlds::text(&evil));
    let version = ("version", worlds::text(&evil));
    for request in [
        worlds::join(&evil),
        worlds::destroy(&evil),
        worlds::create(worlds::settings(&evil, [])),
        worlds::create(worlds::settings("CartPole", [world_name()])),
        worlds::create(worlds::settings("CartPole", [version])),
        worlds::create(worlds::settings("CartPole", [(&*evil, worlds::text("x"))])),
        worlds::property(worlds::read(&evil)),
        worlds::property(worlds::write(&evil, worlds::text(&evil))),
        worlds::property(worlds::list(&evil)),
    ] {
        is_harmless(&agent.refused(request).await.1);
    }
    // A header cannot have control characters, but it may be long and not UTF-8.
    let mut client = crate::common::server::client(server.tcp()).await;
    let stranger = within(Session::show(&mut client, Some(&"e".repeat(8_000)))).await;
    let status = stranger.err().unwrap();
    assert_eq!(status.code(), Code::Unauthenticated);
    is_harmless(status.message());

    let log = server.log();
    assert!(log.contains("evil"), "refusals are in a log of this level:\n{log}");
    for line in log.lines() {
        assert!(line.len() < LONGEST_LINE, "a line of {} bytes: {}", line.len(), &line[..LONGEST]);
        assert!(!line.contains(|letter: char| letter.is_control() || letter == '\u{202e}'), "{line:?}");
    }
}

#[tokio::test]
async fn what_goes_wrong_in_a_library_on_clients_demand_is_not_logged() {
    const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
    let server = Server::start(&[]);
    // Invalid headers, a frame for an unknown stream, an overflowing window, endless resets, an invalid end.
    let resets: Vec<u8> = (0..3_000_u32).flat_map(|n| reset(2 * n + 1)).collect();
    for frames in [
        &b"\0\0\x05\x01\x04\0\0\0\x01\xFF\xFF\xFF\xFF\xFF"[..],
        b"\0\0\x04\0\0\0\0\0\0nono",
        b"\0\0\x04\x08\0\0\0\0\0\x7F\xFF\xFF\xFF",
        b"\0\0\x08\x07\0\0\0\0\0\0\0\0\0\0\0\0\x01",
        &resets,
        b"GET / HTTP/1.1\r\n\r\n",
    ] {
        let mut connection = TcpStream::connect(server.port()).unwrap();
        // An error is ignored, because the server may close the connection before it has read everything.
        let _ = connection.write_all(&[PREFACE, frames].concat());
        let _ = std::io::Read::read_to_end(&mut connection.try_clone().unwrap(), &mut Vec::new());
    }
    let (mut session, _) = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    session.step(vec![0; 4].into()).await;
    let log = server.log();
    for library in [" h2", " hyper", " tonic", " rustls", " tower"] {
        assert!(!log.contains(library), "{library} speaks:\n{log}");
    }
}

/// Returns the frames that start a stream, with a header `:method GET`, and reset it.
fn reset(stream: u32) -> Vec<u8> {
    let id = stream.to_be_bytes();
    [&b"\0\0\x01\x01\x05"[..], &id, b"\x82", b"\0\0\x04\x03\0", &id, b"\0\0\0\x08"].concat()
}
