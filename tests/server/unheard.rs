//! Servers whose log cannot be written, because its disk is full or its reader has ended.

use crate::common::server::{Server, Session, command, open};
use std::process::Command;

/// Returns the command of a server with these flags whose standard error cannot be written.
fn unheard(flags: &[&str]) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", "exec \"$@\" 2>/dev/full", "sh"]).arg(command().get_program()).args(flags);
    shell
}

#[tokio::test]
async fn a_server_that_cannot_log_serves_and_ends_in_order() {
    let flags = ["--listen", "tcp://127.0.0.1:0", "--log", "info", "--grace-seconds", "1"];
    let mut server = Server::spawn(unheard(&flags), tempfile::tempdir().unwrap(), 1);
    let (mut lasting, _) = Session::open(server.tcp(), open("CartPole", 1, 1)).await;
    for seed in 0..3 {
        // The end of this session is logged.
        let (mut session, _) = Session::open(server.tcp(), open("CartPole", 1, seed)).await;
        session.close();
        assert_eq!(session.end().await.code(), tonic::Code::Ok);
        lasting.step(vec![0; 4].into()).await;
    }
    server.signal("TERM");
    assert_eq!(server.ended().await.code(), Some(0));
}

/// The program that started the server was killed while another client's session runs. The server logs a warning before
/// it ends.
#[tokio::test]
async fn private_server_that_cannot_warn_removes_its_folder() {
    let directory = tempfile::tempdir().unwrap();
    let folder = directory.path().join("own");
    std::fs::create_dir(&folder).unwrap();
    let address = format!("unix:{}", folder.join("socket").display());
    let flags = ["--private", "--log", "warn", "--listen", &address];
    let mut server = Server::spawn(unheard(&flags), directory, 1);
    let (_lasting, _) = Session::open(server.unix(), open("CartPole", 1, 1)).await;
    server.stdin = None;
    assert_eq!(server.ended().await.code(), Some(0));
    assert!(!folder.exists());
}
