//! Training on servers that ask who comes, and over lines that change what passes.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use tempfile::TempDir;

use crate::common::{ended, perturb, stderr};

const TOKEN: &str = "correct-horse-battery";

struct Guarded {
    server: Child,
    directory: TempDir,
    port: String,
}

impl Guarded {
    fn start() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let file = |name: &str, text: &str| std::fs::write(directory.path().join(name), text).expect("written");
        let mut authority = CertificateParams::new(Vec::new()).expect("no names");
        authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let [its, own] = [(); 2].map(|()| KeyPair::generate().expect("a key"));
        file("ca.pem", &authority.self_signed(&its).expect("signed").pem());
        let server = CertificateParams::new(vec!["127.0.0.1".to_owned()]).expect("a name");
        file("server.pem", &server.signed_by(&own, &Issuer::new(authority, its)).expect("signed").pem());
        file("server.key", &own.serialize_pem());
        file("tokens.toml", &format!("[[token]]\nname = \"ann\"\ntoken = \"{TOKEN}\"\n"));
        file("token", TOKEN);
        file("another", "another-horse-battery");
        let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
        let mut server = Command::new(program)
            .current_dir(directory.path())
            .args(["--listen", "tcp://127.0.0.1:0", "--tls-cert", "server.pem", "--tls-key", "server.key"])
            .args(["--tokens", "tokens.toml", "--workers", "1", "--log", "error"])
            .stdout(Stdio::piped())
            .spawn()
            .expect("perturb-server");
        let mut line = String::new();
        BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let port = line.trim().strip_prefix("listening on https://127.0.0.1:").expect("an address").to_owned();
        Self { server, directory, port }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Trains by that port.
    fn train(&self, port: &str, out: &str, token: Option<&str>) -> Output {
        let mut command = perturb(&["train", "--server", &format!("https://127.0.0.1:{port}"), "--server-wait", "100"]);
        command.args(["--env", "CartPole", "--version", "R", "--algorithm", "a2c", "--architecture", "ff"]);
        command.args(["--episodes", "60", "--seed", "1", "--out"]).arg(self.file(out));
        command.env("PERTURB_CA", self.file("ca.pem"));
        if let Some(token) = token {
            command.env("PERTURB_TOKEN_FILE", self.file(token));
        }
        ended(command.spawn().expect("perturb"))
    }
}

impl Drop for Guarded {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// The weights that a training came to: their file's name, which counts the episodes, and its bytes.
fn weights(run: &Path) -> (String, Vec<u8>) {
    let files = std::fs::read_dir(run.join("checkpoint")).expect("a checkpoint");
    let mut files = files.map(|file| file.expect("a file").path());
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let file = files.find(|path| name(path).starts_with("weights-")).expect("weights");
    (name(&file), std::fs::read(file).expect("read"))
}

/// A line to that port on which one bit of the byte at `place` from the server is changed, of the first connection, and
/// whether that has come.
fn line(port: &str, place: usize) -> (String, Arc<AtomicBool>) {
    let changed = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&changed);
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let (own, server) = (listener.local_addr().expect("bound").port().to_string(), format!("127.0.0.1:{port}"));
    thread::spawn(move || {
        for (number, client) in listener.incoming().map_while(Result::ok).enumerate() {
            let Ok(upstream) = TcpStream::connect(&server) else { return };
            let (mut from_client, mut to_server) =
                (client.try_clone().expect("cloned"), upstream.try_clone().expect("cloned"));
            thread::spawn(move || {
                let _ = std::io::copy(&mut from_client, &mut to_server);
                let _ = to_server.shutdown(std::net::Shutdown::Write);
            });
            let told = Arc::clone(&told);
            thread::spawn(move || {
                let (mut from_server, mut to_client) = (upstream, client);
                let (mut buffer, mut come) = (vec![0; 1 << 14], 0);
                while let Ok(count @ 1..) = from_server.read(&mut buffer) {
                    if number == 0 && (come..come + count).contains(&place) {
                        buffer[place - come] ^= 1;
                        told.store(true, Ordering::Relaxed);
                    }
                    come += count;
                    if to_client.write_all(&buffer[..count]).is_err() {
                        break;
                    }
                }
                let _ = to_client.shutdown(std::net::Shutdown::Both);
            });
        }
    });
    (own, changed)
}

#[test]
fn a_training_shows_its_token_and_is_told_at_once_when_that_is_no_good() {
    let guarded = Guarded::start();
    let trained = guarded.train(&guarded.port, "good", Some("token"));
    assert!(trained.status.success(), "{}", stderr(&trained));
    for (token, part) in [(None, "asks for a token"), (Some("another"), "does not know the token")] {
        let refused = guarded.train(&guarded.port, "bad", token);
        assert!(!refused.status.success());
        let words = stderr(&refused);
        assert!(words.contains(part) && !words.contains("waiting for it"), "{words}");
    }
}

#[test]
fn a_changed_byte_never_changes_what_is_learnt() {
    let guarded = Guarded::start();
    let trained = guarded.train(&guarded.port, "truth", Some("token"));
    assert!(trained.status.success(), "{}", stderr(&trained));
    let truth = weights(&guarded.file("truth"));
    let mut reached = 0;
    for place in [100, 1_000, 2_000, 5_000, 10_000, 20_000] {
        let (port, changed) = line(&guarded.port, place);
        let out = format!("at-{place}");
        let trained = guarded.train(&port, &out, Some("token"));
        println!("a byte changed at {place}: status {}, {}", trained.status, stderr(&trained).trim());
        if trained.status.success() {
            assert!(weights(&guarded.file(&out)) == truth, "the byte at {place} was believed");
        } else {
            assert!(changed.load(Ordering::Relaxed), "nothing was wrong: {}", stderr(&trained));
        }
        reached += usize::from(changed.load(Ordering::Relaxed));
    }
    assert!(reached >= 3, "only {reached} of the bytes ever came");
}
