//! Insecure settings, which are refused before a port is bound, and secure settings.

use super::connect;
use crate::{
    common::server::{Server, command},
    lifecycle::finished,
};
use perturb_faults::certificates::Authority;
use rstest::rstest;
use std::{os::unix::fs::PermissionsExt, process::Command, time::Instant};

/// Runs a server that must refuse its settings. Returns its message.
fn refused(mut command: Command) -> String {
    let output = finished(&mut command);
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0), "{command:?}: {words}");
    words
}

#[rstest]
#[case::nothing(&["--listen", "tcp://0.0.0.0:0"], "neither encrypt connections nor")]
#[case::ipv6(&["--listen", "tcp://[::]:0"], "neither encrypt connections nor")]
#[case::second(&["--listen", "tcp://127.0.0.1:0", "--listen", "tcp://0.0.0.0:0"], "tcp://0.0.0.0:0 can be reached")]
#[case::tokens(&["--listen", "tcp://0.0.0.0:0", "--tokens", "x"], "unencrypted")]
#[case::tls(&["--listen", "tcp://0.0.0.0:0", "--tls-cert", "x", "--tls-key", "x"], "not authenticate them")]
fn reachable_address_is_guarded_or_called_insecure(#[case] flags: &[&str], #[case] part: &str) {
    let mut command = command();
    command.args(flags);
    let words = refused(command);
    assert!(words.contains(part) && words.contains("--insecure") && words.contains("--tls-cert"), "{words}");
}

#[rstest]
#[case::no_key(&["--tls-cert", "x"], "tls_key is not given")]
#[case::no_cert(&["--tls-key", "x"], "tls_cert is not given")]
#[case::only_ca(&["--tls-client-ca", "x"], "tls_cert is not given")]
#[case::no_tokens(&["--tokens", "/nowhere/tokens"], "cannot read /nowhere/tokens")]
#[case::no_files(&["--tls-cert", "/nowhere/cert", "--tls-key", "/nowhere/key"], "cannot read /nowhere/cert")]
#[case::devices(&["--tls-cert", "/dev/null", "--tls-key", "/dev/null"], "expected a regular file")]
#[case::endless_tokens(&["--tokens", "/dev/zero"], "cannot read /dev/zero: it is a pipe or a device")]
#[case::folder(&["--tokens", "/"], "it is a folder, expected a file")]
#[case::endless_ledger(&["--ledger", "/dev/zero"], "this is not a regular file")]
#[case::endless_config(&["--config", "/dev/zero"], "cannot read /dev/zero: it is a pipe or a device")]
#[case::decimal(&["--socket-mode", "438"], "not a mode of a socket")]
#[case::executable(&["--socket-mode", "0700"], "such as 0600")]
fn a_wrong_guard_is_refused(#[case] flags: &[&str], #[case] part: &str) {
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0"]).args(flags);
    let words = refused(command);
    assert!(words.contains(part), "{words}");
}

#[test]
fn a_large_config_file_is_refused_by_its_size() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), vec![b'#'; (1 << 20) + 1]).unwrap();
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0", "--config"]).arg(file.path());
    let words = refused(command);
    assert!(words.contains("it has 1048577 bytes, expected 1048576 at most"), "{words}");
}

#[test]
fn a_wrong_file_of_tokens_is_refused_with_its_line() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), "[[token]]\nname = \"ann\"\ntokn = \"correct-horse-battery\"").unwrap();
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0", "--tokens"]).arg(file.path());
    let words = refused(command);
    assert!(words.contains("line 3: unknown field `tokn`") && !words.contains("horse"), "{words}");
}

#[test]
fn a_pipe_is_refused_at_the_start_and_not_waited_for() {
    let directory = tempfile::tempdir().unwrap();
    let pipe = directory.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for flag in ["--tokens", "--ledger", "--config"] {
        let mut command = command();
        command.args(["--listen", "tcp://127.0.0.1:0", flag]).arg(&pipe);
        let words = refused(command);
        assert!(words.contains("regular file"), "{flag}: {words}");
    }
}

#[test]
fn a_file_without_a_certificate_is_refused() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut command = command();
    command.args(["--listen", "tcp://127.0.0.1:0", "--tls-key"]).arg(file.path()).arg("--tls-cert").arg(file.path());
    let words = refused(command);
    assert!(words.contains("contains no certificate"), "{words}");
}

#[test]
fn a_new_token_is_printed_with_its_entry() {
    let output = command().args(["--new-token", "ann"]).output().unwrap();
    let (token, entry) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert_eq!(token.trim().len(), 64);
    assert!(entry.starts_with("[[token]]\nname = \"ann\"\nsha256 = \"") && !entry.contains(token.trim()), "{entry}");
}

#[tokio::test]
async fn with_insecure_everybody_may() {
    let directory = tempfile::tempdir().unwrap();
    let mut command = command();
    command.args(["--listen", "tcp://0.0.0.0:0", "--insecure"]);
    let server = Server::spawn(command, directory, 1);
    connect(&server.tcp().replace("0.0.0.0", "127.0.0.1"), &[]).await.unwrap();
}

#[rstest]
#[case(&[], 0o600)]
#[case(&["--socket-mode", "0660"], 0o660)]
fn a_socket_has_its_mode(#[case] flags: &[&str], #[case] mode: u32) {
    let server = Server::start(flags);
    assert_eq!(std::fs::metadata(server.socket()).unwrap().permissions().mode() & 0o777, mode);
}

#[rstest]
#[case::serves(true)]
#[case::another(false)]
fn health_is_asked_through_tls(#[case] is_own: bool) {
    let directory = tempfile::tempdir().unwrap();
    let authority = Authority::new("authority");
    // The certificate does not have the name or address of the loopback interface.
    let pair = authority.issue(directory.path(), "server", &["example.org"], 2040);
    let other = authority.issue(directory.path(), "other", &["example.org"], 2040);
    let [cert, key] = [&pair.cert, &pair.key].map(|path| path.to_str().unwrap());
    let server = Server::start(&["--tls-cert", cert, "--tls-key", key]);
    let asked = if is_own { &pair } else { &other };
    let start = Instant::now();
    let output = command()
        .args(["--health", "--listen", server.addresses[0].strip_prefix("https://").unwrap(), "--tls-cert"])
        .arg(&asked.cert)
        .arg("--tls-key")
        .arg(&asked.key)
        .output()
        .unwrap();
    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.success(), is_own, "{words}");
    assert!(is_own || words.contains("its certificate is not the expected one"), "{words} after {:?}", start.elapsed());
}
