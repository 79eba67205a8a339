//! TLS: certificates of servers and of clients.

use super::{begin, connect, logged, steps, unauthenticated, unsafe_words};
use crate::common::server::{self, Server, within};
use perturb_faults::{
    ByteFault, FaultKind, FaultPlan, FaultyProxy,
    certificates::{Authority, CertificateFiles},
};
use perturb_protocol::{
    ClientError,
    credentials::{CA, CERT, KEY, TOKEN_FILE},
};
use rstest::rstest;
use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};
use tempfile::TempDir;
use tokio::{io::AsyncReadExt, net::TcpStream};

struct Encrypted {
    server: Server,
    directory: TempDir,
    authority: Authority,
    ca: PathBuf,
}

impl Encrypted {
    fn start(names: &[&str], until_year: i32, more: &[(&str, &Path)]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let authority = Authority::new("authority");
        let CertificateFiles { cert, key } = authority.issue(directory.path(), "server", names, until_year);
        let ca = authority.file(directory.path(), "ca.pem");
        let mut flags = vec!["--log", "debug", "--tls-cert", cert.to_str().unwrap()];
        flags.extend(["--tls-key", key.to_str().unwrap()]);
        for (flag, path) in more {
            flags.extend([*flag, path.to_str().unwrap()]);
        }
        Self { server: Server::start(&flags), directory, authority, ca }
    }

    fn usual() -> Self {
        Self::start(&["127.0.0.1", "localhost"], 2040, &[])
    }

    fn address(&self) -> &str {
        &self.server.addresses[0]
    }
}

#[tokio::test]
async fn who_trusts_the_authority_plays_and_the_socket_stays_plain() {
    let encrypted = Encrypted::usual();
    assert!(encrypted.address().starts_with("https://127.0.0.1:"), "{}", encrypted.address());
    let named = encrypted.address().replace("127.0.0.1", "localhost");
    for address in [encrypted.address(), &named] {
        let connection = connect(address, &[(CA, &encrypted.ca)]).await.unwrap();
        let mut session = begin(&connection, 3).await.unwrap();
        for _ in 0..5 {
            steps(&mut session, 3).await.unwrap();
        }
    }
    begin(&connect(encrypted.server.unix(), &[]).await.unwrap(), 1).await.unwrap();
}

#[rstest]
#[case::unknown(&["127.0.0.1"], 2040, false, "no trusted authority")]
#[case::expired(&["127.0.0.1"], 2021, true, "has expired")]
#[case::another_name(&["example.org"], 2040, true, "not for this name")]
#[tokio::test]
async fn a_server_that_is_not_to_be_trusted_is_not(
    #[case] names: &[&str],
    #[case] until_year: i32,
    #[case] trusts: bool,
    #[case] part: &str,
) {
    let encrypted = Encrypted::start(names, until_year, &[]);
    let other = Authority::new("authority").file(encrypted.directory.path(), "other.pem");
    let ca = if trusts { &encrypted.ca } else { &other };
    let words = unsafe_words(connect(encrypted.address(), &[(CA, ca)]).await);
    assert!(words.contains(part), "{words}");
}

#[tokio::test]
async fn tls_and_plain_connections_that_meet_are_told_apart() {
    let encrypted = Encrypted::usual();
    let plain = encrypted.address().replace("https", "http");
    let words = unsafe_words(connect(&plain, &[]).await);
    assert!(words.contains("the server uses TLS; write https://"), "{words}");
    let server = Server::start(&[]);
    let error = connect(&server.tcp().replace("http", "https"), &[(CA, &encrypted.ca)]).await.unwrap_err();
    assert!(error.to_string().contains("write tcp:// instead of https://"), "{error}");
}

#[tokio::test]
async fn a_server_may_ask_for_certificates_of_clients() {
    let directory = tempfile::tempdir().unwrap();
    let clients = Authority::new("clients");
    let client_ca = clients.file(directory.path(), "clients.pem");
    let encrypted = Encrypted::start(&["127.0.0.1"], 2040, &[("--tls-client-ca", &client_ca)]);
    let good = clients.issue(directory.path(), "good", &["ann"], 2040);
    let old = clients.issue(directory.path(), "old", &["ann"], 2021);
    let bad = Authority::new("clients").issue(directory.path(), "bad", &["ann"], 2040);
    let with = async |pair: &CertificateFiles| {
        connect(encrypted.address(), &[(CA, &encrypted.ca), (CERT, &pair.cert), (KEY, &pair.key)]).await
    };
    let connection = with(&good).await.unwrap();
    let _session = begin(&connection, 1).await.unwrap();
    for (pair, part) in [(old, "has expired; have it renewed"), (bad, "accepts no client with the certificate")] {
        let words = unsafe_words(with(&pair).await);
        assert!(words.contains(part), "{words}");
    }
    let words = unsafe_words(connect(encrypted.address(), &[(CA, &encrypted.ca)]).await);
    assert!(words.contains("asks for a client's certificate; set PERTURB_CERT"), "{words}");
    let half = unsafe_words(connect(encrypted.address(), &[(CA, &encrypted.ca), (CERT, &good.cert)]).await);
    assert!(half.contains("PERTURB_KEY is not"), "{half}");
    // An error because the server ends is not a certificate error, so clients retry.
    encrypted.server.signal("TERM");
    let error = with(&good).await.unwrap_err();
    assert!(error.is_absence() && error.to_string().contains("shutting down"), "{error}");
}

#[tokio::test]
async fn new_certificates_are_loaded_and_broken_ones_are_not() {
    let encrypted = Encrypted::usual();
    let connection = connect(encrypted.address(), &[(CA, &encrypted.ca)]).await.unwrap();
    let mut session = begin(&connection, 1).await.unwrap();
    std::fs::write(encrypted.directory.path().join("server.pem"), "nothing").unwrap();
    logged(&encrypted.server, "the previous contents stay in force").await;
    connect(encrypted.address(), &[(CA, &encrypted.ca)]).await.unwrap();

    let other = Authority::new("another authority");
    other.issue(encrypted.directory.path(), "server", &["127.0.0.1"], 2040);
    logged(&encrypted.server, "read the TLS files again").await;
    let ca = other.file(encrypted.directory.path(), "another.pem");
    connect(encrypted.address(), &[(CA, &ca)]).await.unwrap();
    unsafe_words(connect(encrypted.address(), &[(CA, &encrypted.ca)]).await);
    steps(&mut session, 1).await.expect("connections go on");
    drop(encrypted.authority);
}

#[tokio::test]
async fn tokens_go_through_tls() {
    let directory = tempfile::tempdir().unwrap();
    let [tokens, token] = ["tokens.toml", "token"].map(|name| directory.path().join(name));
    std::fs::write(&tokens, "[[token]]\nname = \"ann\"\ntoken = \"correct-horse-battery\"").unwrap();
    std::fs::write(&token, "correct-horse-battery").unwrap();
    let encrypted = Encrypted::start(&["127.0.0.1"], 2040, &[("--tokens", &tokens)]);
    let ann = connect(encrypted.address(), &[(CA, &encrypted.ca), (TOKEN_FILE, &token)]).await.unwrap();
    begin(&ann, 1).await.unwrap();
    unauthenticated(begin(&connect(encrypted.address(), &[(CA, &encrypted.ca)]).await.unwrap(), 1).await);
}

#[tokio::test]
async fn handshakes_that_do_not_end_hold_up_nobody() {
    let encrypted = Encrypted::start(&["127.0.0.1"], 2040, &[("--handshake-seconds", Path::new("2"))]);
    let port = encrypted.address().strip_prefix("https://").unwrap();
    let mut silent = Vec::new();
    for _ in 0..50 {
        silent.push(TcpStream::connect(port).await.unwrap());
    }
    let start = Instant::now();
    let connection = connect(encrypted.address(), &[(CA, &encrypted.ca)]).await.unwrap();
    begin(&connection, 1).await.unwrap();
    println!("a client among 50 silent ones came in after {:?}", start.elapsed());
    for mut one in silent {
        let ended = within(one.read_u8()).await;
        assert!(ended.is_err(), "the server ends it");
    }
    assert!(start.elapsed() >= Duration::from_secs(1), "they had their time");
}

#[tokio::test]
async fn with_tls_no_changed_byte_is_taken_for_the_servers() {
    let encrypted = Encrypted::usual();
    let played = async |address: String| -> Result<Vec<Vec<u8>>, ClientError> {
        let connection = connect(&address, &[(CA, &encrypted.ca)]).await?;
        let opening = perturb_protocol::Stream::open(&connection, server::open("CartPole", 16, 1));
        let (mut stream, opened) = within(opening).await?;
        let mut played = vec![opened.observations.to_vec()];
        for _ in 0..20 {
            let step = perturb::proto::Step { actions: vec![0; 64].into() };
            played.push(within(stream.ask(step)).await?.observations.to_vec());
        }
        Ok(played)
    };
    let truth = played(encrypted.address().into()).await.unwrap();
    let mut errors = 0;
    for place in [3, 60, 200, 700, 1000, 1500, 2000, 3000, 4000, 6000] {
        let from_server = Some(ByteFault { at: place, kind: FaultKind::BitFlip });
        let line = FaultyProxy::start(encrypted.address(), move |_| FaultPlan { from_server, ..FaultPlan::default() })
            .unwrap();
        match played(format!("https://{}", line.address())).await {
            Ok(same) => assert_eq!(same, truth, "the byte at {place} was changed, and believed"),
            Err(error) => {
                errors += 1;
                println!("{place}: {error}");
            }
        }
    }
    assert!(errors >= 5, "only {errors} of 10 changes were noticed");
}
