//! Tokens: authentication, quotas of sessions, reloading, revocation.

use super::{begin, connect, logged, steps, unauthenticated};
use crate::{
    bounds::client,
    common::server::{Server, within},
};
use perturb_protocol::{
    ClientError, Connection,
    credentials::{INSECURE, TOKEN_FILE},
};
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tonic::Code;

pub(super) const ANN: &str = "correct-horse-battery";
pub(super) const BOB: &str = "staple-correct-horse";

pub(super) struct Guarded {
    pub(super) server: Server,
    pub(super) directory: TempDir,
    pub(super) file: PathBuf,
}

pub fn entry(name: &str, token: &str, more: &str) -> String {
    format!("[[token]]\nname = \"{name}\"\ntoken = \"{token}\"\n{more}\n")
}

impl Guarded {
    pub(super) fn start(tokens: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let ledger = directory.path().join("ledger");
        Self::with_flags(tokens, directory, &["--ledger", ledger.to_str().unwrap()])
    }

    /// Starts a server without a ledger. The lines of a ledger would add to the price of requests.
    pub(super) fn without_ledger(tokens: &str) -> Self {
        Self::with_flags(tokens, tempfile::tempdir().unwrap(), &[])
    }

    fn with_flags(tokens: &str, directory: TempDir, flags: &[&str]) -> Self {
        let file = directory.path().join("tokens.toml");
        std::fs::write(&file, tokens).unwrap();
        let guard = ["--tokens", file.to_str().unwrap(), "--log", "debug"];
        let server = Server::start(&[&guard, flags].concat());
        Self { server, directory, file }
    }

    pub(super) async fn connect(&self, token: &str) -> Connection {
        let file = self.directory.path().join(token);
        std::fs::write(&file, format!("{token}\n")).unwrap();
        connect(self.server.tcp(), &[(TOKEN_FILE, &file)]).await.unwrap()
    }
}

#[tokio::test]
async fn who_has_a_token_comes_in_and_others_do_not() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let ann = guarded.connect(ANN).await;
    assert!(!within(ann.catalogue()).await.unwrap().environments.is_empty());
    let mut session = begin(&ann, 4).await.unwrap();
    steps(&mut session, 4).await.unwrap();

    let stranger = connect(guarded.server.tcp(), &[]).await.unwrap();
    let words = unauthenticated(begin(&stranger, 1).await);
    assert!(words.contains("requires a token") && words.contains(TOKEN_FILE), "{words}");
    unauthenticated(within(stranger.catalogue()).await);
    let words = unauthenticated(begin(&guarded.connect(&ANN.to_uppercase()).await, 1).await);
    assert!(words.contains("does not know the token"), "{words}");

    let neighbour = connect(guarded.server.unix(), &[]).await.unwrap();
    begin(&neighbour, 1).await.expect("a Unix socket has its own guard");
    let log = guarded.server.log();
    assert!(
        log.contains("token=\"ann\"") && !log.to_lowercase().contains(ANN),
        "names are logged, tokens are not:\n{log}"
    );
}

#[tokio::test]
async fn every_service_but_health_asks_for_a_token() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let mut connection = client::Connection::new(guarded.server.port(), 1 << 16).await;
    for path in [
        client::SESSION,
        client::LIST,
        "/dm_env_rpc.v1.Environment/Process",
        "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
    ] {
        let (code, message) = connection.call(path).await.unwrap().status().await.unwrap();
        assert_eq!(code, Code::Unauthenticated as i32, "{path}: {message}");
    }
    connect(guarded.server.tcp(), &[]).await.expect("its health is told");
}

#[tokio::test]
async fn a_token_that_is_taken_out_of_the_file_is_good_no_more() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let ann = guarded.connect(ANN).await;
    let mut session = begin(&ann, 1).await.unwrap();
    std::fs::write(&guarded.file, "[[token]]\nname = \"bob\"").unwrap();
    logged(&guarded.server, "the previous contents stay in force").await;
    steps(&mut session, 1).await.expect("a broken file changes nothing");
    begin(&ann, 1).await.unwrap();

    std::fs::write(&guarded.file, entry("bob", BOB, "")).unwrap();
    logged(&guarded.server, "read tokens again").await;
    let words = unauthenticated(steps(&mut session, 1).await);
    assert!(words.contains("\"ann\" was revoked"), "{words}");
    unauthenticated(begin(&ann, 1).await);
    begin(&guarded.connect(BOB).await, 1).await.unwrap();
}

#[tokio::test]
async fn hangup_reads_files_again_and_ends_nobody() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    let mut session = begin(&guarded.connect(ANN).await, 1).await.unwrap();
    guarded.server.signal("HUP");
    logged(&guarded.server, "read tokens again").await;
    steps(&mut session, 1).await.expect("no session ends");
    let unguarded = Server::start(&[]);
    unguarded.signal("HUP");
    logged(&unguarded, "no token or TLS files to reload").await;
    let plain = connect(unguarded.tcp(), &[]).await.unwrap();
    begin(&plain, 1).await.unwrap();
}

#[tokio::test]
async fn a_file_that_becomes_a_pipe_is_told_and_stops_nothing() {
    let guarded = Guarded::start(&entry("ann", ANN, ""));
    std::fs::remove_file(&guarded.file).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&guarded.file).status().unwrap().success());
    logged(&guarded.server, "it is a pipe or a device").await;
    begin(&guarded.connect(ANN).await, 1).await.expect("the tokens of before stay in force");
    std::fs::remove_file(&guarded.file).unwrap();
    std::fs::write(&guarded.file, entry("bob", BOB, "")).unwrap();
    logged(&guarded.server, "read tokens again").await;
    begin(&guarded.connect(BOB).await, 1).await.expect("the watcher goes on");
}

#[tokio::test]
async fn a_token_has_its_quotas() {
    let guarded = Guarded::start(&(entry("ann", ANN, "max_sessions = 2\nmax_envs = 8") + &entry("bob", BOB, "")));
    let ann = guarded.connect(ANN).await;
    let refused = |result: Result<_, ClientError>| match result.unwrap_err() {
        ClientError::Refused { code: Code::ResourceExhausted, message: words, .. }
        | ClientError::Lost { code: Code::ResourceExhausted, reason: words, .. } => words,
        other => panic!("{other:?}"),
    };
    let six = begin(&ann, 6).await.unwrap();
    let words = refused(begin(&guarded.connect(ANN).await, 3).await.map(drop));
    assert!(words.contains("\"ann\" may have 8 environments"), "{words}");
    // The refused session returns its part of the quota as soon as its connection's thread learns that the client has
    // disconnected.
    let mut two = None;
    crate::common::server::until("its place can be had", async || {
        two = begin(&ann, 2).await.ok();
        two.is_some()
    })
    .await;
    let words = refused(begin(&ann, 1).await.map(drop));
    assert!(words.contains("\"ann\" may have 2 sessions"), "{words}");
    begin(&guarded.connect(BOB).await, 100).await.expect("another's token has its own");
    drop(six);
    crate::common::server::until("what was given back can be had", async || begin(&ann, 6).await.is_ok()).await;
}

#[tokio::test]
async fn a_clients_own_mistakes_are_told() {
    let directory = tempfile::tempdir().unwrap();
    let nothing = directory.path().join("nothing");
    let words = super::unsafe_words(connect("127.0.0.1:9", &[(TOKEN_FILE, &nothing)]).await);
    assert!(words.contains("PERTURB_TOKEN_FILE=") && words.contains("one line with a token"), "{words}");
    std::fs::write(&nothing, ANN).unwrap();
    let words = super::unsafe_words(connect("192.0.2.1:9", &[(TOKEN_FILE, &nothing)]).await);
    assert!(words.contains("unencrypted") && words.contains("https://192.0.2.1:9"), "{words}");
    let variables: [(&str, &Path); 2] = [(TOKEN_FILE, &nothing), (INSECURE, Path::new("1"))];
    assert!(connect("127.0.0.1:9", &variables).await.unwrap_err().is_absence());
}
