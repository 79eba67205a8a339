//! `perturb serve`: its printed address and how it ends. The package perturb-serve tests the contents of pages.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::process::Child;

use crate::common::{LIMIT, ended, kill, perturb};

/// Serves an empty folder and returns the printed address.
fn start(folder: &std::path::Path, more: &[&str]) -> (Child, String) {
    let mut command = perturb(&["serve", "."]);
    let mut child = command.args(more).current_dir(folder).spawn().expect("started");
    let mut line = String::new();
    BufReader::new(child.stdout.as_mut().expect("a pipe")).read_line(&mut line).expect("a line");
    (child, line.trim_end().trim_start_matches("http://").to_owned())
}

#[test]
fn ctrl_c_ends_it_at_once_with_an_open_page() {
    let folder = tempfile::tempdir().expect("a folder");
    let (child, address) = start(folder.path(), &["--address", "0"]);
    assert!(address.starts_with("127.0.0.1:"), "{address}");
    let mut stream = TcpStream::connect(&address).expect("it listens");
    stream.set_read_timeout(Some(LIMIT)).expect("a limit");
    write!(stream, "GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n").expect("sent");
    let mut lines = BufReader::new(stream).lines();
    assert!(lines.any(|line| line.is_ok_and(|line| line.starts_with("data: "))), "an event");
    kill("-INT", child.id());
    let output = ended(child);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{said}");
    assert!(said.ends_with("stopped by signal 2\n"), "{said}");
    // Bytes that were sent before the end are read first. A read timeout does not count as the end of the connection.
    match lines.find(Result::is_err) {
        None => {}
        Some(line) => {
            let kind = line.expect_err("an error").kind();
            assert_eq!(kind, ErrorKind::ConnectionReset, "the stream has ended");
        }
    }
    assert_eq!(folder.path().read_dir().expect("a list").count(), 0, "nothing is written");
}

#[test]
fn an_address_that_others_reach_is_warned_about() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut child, address) = start(folder.path(), &["--address", "0.0.0.0:0"]);
    let port = address.rsplit(':').next().expect("a port");
    let mut stream = TcpStream::connect(format!("127.0.0.1:{port}")).expect("it listens");
    write!(stream, "GET / HTTP/1.1\r\nHost: machine.example\r\nConnection: close\r\n\r\n").expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    assert!(
        answer.starts_with("HTTP/1.1 200") && answer.contains("There is no training and no experiment yet"),
        "{answer}"
    );
    child.kill().expect("killed");
    let output = ended(child);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("everybody who reaches this address can see the whole folder"), "{said}");
    assert!(said.contains("so can any web site that they open"), "{said}");
}
