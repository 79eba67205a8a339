//! Addresses of the metrics page, and requests to it.

use super::{Watched, page};
use crate::{
    common::server::{DEADLINE, Server, command, lines, until},
    lifecycle::finished,
};
use rstest::rstest;
use std::{
    net::TcpStream,
    process::{Command, Stdio},
    time::Instant,
};

/// Runs a server that must refuse its settings. Returns its message.
fn refused(mut command: Command) -> String {
    let output = finished(&mut command);
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{command:?}: {words}");
    words
}

#[test]
fn the_address_is_printed_after_those_of_sessions() {
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0", "--metrics", "tcp://127.0.0.1:0"]);
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
    let lines = lines(child.stdout.take().unwrap());
    let line = || lines.recv_timeout(DEADLINE).unwrap();
    assert!(line().starts_with("listening on http://127.0.0.1:"));
    let metrics = line();
    let port =
        metrics.strip_prefix("metrics at http://").and_then(|rest| rest.strip_suffix("/metrics")).expect(&metrics);
    assert!(line().starts_with("gRPC target 127.0.0.1:"), "as gRPC's tools write it");
    let (head, body) = page::asked(page::tcp(port), "GET /metrics");
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(head.starts_with("HTTP/1.1 200") && body.ends_with("# EOF\n"), "{head}");
}

#[rstest]
#[case("GET /", "404", "the metrics are at /metrics")]
#[case("GET /metrics/", "404", "the metrics are at /metrics")]
#[case("POST /metrics", "405", "use GET or HEAD")]
fn what_is_no_page_says_where_it_is(#[case] line: &str, #[case] status: &str, #[case] words: &str) {
    let watched = Watched::start(&[]);
    let (head, body) = page::asked(page::unix(&watched.socket), line);
    assert!(head.starts_with(&format!("HTTP/1.1 {status}")) && body.contains(words), "{head}\n{body}");
}

#[rstest]
#[case::other_machines(&["--metrics", "tcp://0.0.0.0:0"], &["tcp://0.0.0.0:0 of --metrics can be reached", "--insecure"])]
#[case::guarded(&["--metrics", "tcp://[::]:0", "--tokens", "x"], &["tcp://[::]:0 of --metrics can be reached"])]
#[case::no_address(&["--metrics", "http://localhost"], &["is not an address to listen at"])]
#[case::no_folder(&["--metrics", "unix:/nowhere/metrics"], &["its folder does not exist", "correct --metrics"])]
fn a_wrong_address_is_refused_before_anything_is_served(#[case] flags: &[&str], #[case] parts: &[&str]) {
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0"]).args(flags);
    let words = refused(command);
    assert!(parts.iter().all(|part| words.contains(part)), "{words}");
}

#[test]
fn with_insecure_everybody_may_read_them() {
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0", "--metrics", "tcp://0.0.0.0:0", "--insecure"]);
    Server::spawn(command, tempfile::tempdir().unwrap(), 1);
}

#[rstest]
#[case::tcp("tcp://127.0.0.1:0")]
#[case::unix("unix:")]
fn two_servers_at_one_address_are_refused_with_a_sentence(#[case] address: &str) {
    let directory = tempfile::tempdir().unwrap();
    let path = format!("unix:{}", directory.path().join("metrics").display());
    // The port is in use. The message is the same for any program that uses it.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = match address {
        "unix:" => path,
        _ => format!("tcp://{}", taken.local_addr().unwrap()),
    };
    let _first = address.starts_with("unix:").then(|| Server::start(&["--metrics", &address]));
    let mut second = command();
    second.args(["--listen", "tcp://127.0.0.1:0", "--metrics", &address]);
    let words = refused(second);
    assert!(words.contains(&format!("cannot listen at {address}: another program already listens there")), "{words}");
    assert!(words.contains("--metrics") && !words.contains("--listen"), "{words}");
}

#[rstest]
#[case::open_metrics("*/*", "application/openmetrics-text; version=1.0.0", true)]
#[case::text("text/plain;version=0.0.4;q=1,*/*;q=0.1", "text/plain; version=0.0.4", false)]
fn scraper_gets_the_format_that_it_asks_for(#[case] accept: &str, #[case] format: &str, #[case] is_open: bool) {
    let watched = Watched::start(&[]);
    let (head, body) = page::asked_for(page::unix(&watched.socket), "GET /metrics", &format!("Accept: {accept}\r\n"));
    assert!(head.starts_with("HTTP/1.1 200") && head.contains(&format!("content-type: {format}")), "{head}");
    assert_eq!(body.ends_with("# EOF\n"), is_open);
    let counter = if is_open { "# TYPE perturb_steps counter" } else { "# TYPE perturb_steps_total counter" };
    assert!(body.contains(counter) && body.contains("# TYPE perturb_sessions gauge\nperturb_sessions"), "{body}");
}

#[test]
fn head_is_answered_without_a_body() {
    let watched = Watched::start(&[]);
    let (head, body) = page::asked(page::unix(&watched.socket), "HEAD /metrics");
    assert!(head.starts_with("HTTP/1.1 200") && head.contains("application/openmetrics-text"), "{head}");
    assert_eq!(body, "");
}

#[test]
fn half_requests_keep_nobody_from_the_page() {
    use std::io::Write;
    let watched = Watched::start(&[]);
    let start = Instant::now();
    let half: Vec<_> = (0..145)
        .map(|_| {
            let mut stream = page::unix(&watched.socket);
            let _ = stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: "); // fails if the connection is already closed
            stream
        })
        .collect();
    assert!(watched.page().tells("perturb_sessions"));
    assert!(start.elapsed() < std::time::Duration::from_secs(4), "less than one timeout: {:?}", start.elapsed());
    drop(half);
}

#[tokio::test]
async fn who_asks_nothing_keeps_nobody_from_the_page_for_long() {
    let watched = Watched::start(&[]);
    let silent: Vec<_> = (0..40).map(|_| page::unix(&watched.socket)).collect();
    let start = Instant::now();
    until("there is a page", async || watched.page().tells("perturb_sessions")).await;
    println!("a page after {:?}", start.elapsed());
    drop(silent);
}

#[test]
fn a_server_that_ends_removes_its_socket() {
    let watched = Watched::start(&[]);
    watched.server.signal("TERM");
    let start = Instant::now();
    while watched.socket.exists() {
        assert!(start.elapsed() < DEADLINE, "the socket is still there");
        std::thread::sleep(std::time::Duration::from_millis(10));
    }
}

#[test]
fn no_metrics_are_told_unless_asked_for() {
    let server = Server::start(&[]);
    // The port for sessions accepts only HTTP/2.
    let stream = TcpStream::connect(server.port()).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    let mut text = Vec::new();
    use std::io::{Read, Write};
    (&stream).write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let _ = (&stream).read_to_end(&mut text);
    assert!(!String::from_utf8_lossy(&text).contains("perturb_"), "{text:?}");
}
