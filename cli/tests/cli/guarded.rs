//! Training on servers with TLS and tokens, and over connections that corrupt bytes.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use perturb_faults::certificates::Authority;
use perturb_faults::{ByteFault, FaultKind, FaultPlan, FaultyProxy};
use rstest::rstest;
use tempfile::TempDir;

use crate::common::{ended, perturb, stderr};

/// A server that requires a client certificate and a token. The token's role may draw from D and R.
pub struct Guarded {
    server: Child,
    directory: TempDir,
    pub address: String,
}

/// Credentials of a client.
#[derive(Clone, Copy)]
pub struct Has {
    /// Trusted certificate authority.
    ca: &'static str,
    /// Client certificate.
    cert: Option<&'static str>,
    token: Option<&'static str>,
}

/// Valid credentials, with all that the server requires.
pub const ALL: Has = Has { ca: "ca.pem", cert: Some("client"), token: Some("token") };

const TOKENS: &str = "
[[token]]
name = 'ann'
token = 'correct-horse-battery'
role = 'train'

[[role]]
name = 'train'
draws = ['D', 'R']
";

impl Guarded {
    pub fn start() -> Self {
        Self::until(2040)
    }

    /// Starts a server whose certificate is valid until `year`.
    fn until(year: i32) -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let folder = directory.path();
        let [servers, clients, strangers] = ["servers", "clients", "clients"].map(Authority::new);
        servers.file(folder, "ca.pem");
        clients.file(folder, "clients.pem");
        strangers.file(folder, "strangers.pem");
        servers.issue(folder, "server", &["127.0.0.1"], year);
        clients.issue(folder, "client", &["ann"], 2040);
        clients.issue(folder, "old", &["ann"], 2021);
        strangers.issue(folder, "stranger", &["ann"], 2040);
        let file = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("written");
        file("tokens.toml", TOKENS);
        file("token", "correct-horse-battery");
        file("another", "another-horse-battery");
        let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
        let mut server = Command::new(program)
            .current_dir(folder)
            .args(["--listen", "tcp://127.0.0.1:0", "--tls-cert", "server.pem", "--tls-key", "server.key"])
            .args(["--tls-client-ca", "clients.pem", "--tokens", "tokens.toml", "--workers", "1", "--log", "error"])
            .stdout(Stdio::piped())
            .spawn()
            .expect("perturb-server");
        let mut line = String::new();
        BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
        Self { server, directory, address }
    }

    pub fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Adds the credentials to the environment of `command`.
    pub fn equip(&self, command: &mut Command, has: Has) {
        command.env("PERTURB_CA", self.file(has.ca));
        if let Some(cert) = has.cert {
            command.env("PERTURB_CERT", self.file(cert).with_extension("pem"));
            command.env("PERTURB_KEY", self.file(cert).with_extension("key"));
        }
        if let Some(token) = has.token {
            command.env("PERTURB_TOKEN_FILE", self.file(token));
        }
    }

    /// Trains a policy on a version, with the server at `address`.
    fn train(&self, address: &str, out: &str, version: &str, has: Has) -> Output {
        let mut command = perturb(&["train", "--server", address, "--server-wait", "100", "--version", version]);
        command.args(["--env", "CartPole", "--algorithm", "a2c", "--architecture", "ff"]);
        command.args(["--episodes", "60", "--seed", "1", "--out"]).arg(self.file(out));
        self.equip(&mut command, has);
        ended(command.spawn().expect("perturb"))
    }
}

impl Drop for Guarded {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// Returns the final weights of a training: the name of their file, which contains the number of iterations, and the
/// file's bytes.
pub fn weights(run: &Path) -> (String, Vec<u8>) {
    let files = std::fs::read_dir(run.join("checkpoint")).expect("a checkpoint");
    let mut files = files.map(|file| file.expect("a file").path());
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let file = files.find(|path| name(path).starts_with("weights-")).expect("weights");
    (name(&file), std::fs::read(file).expect("read"))
}

#[rstest]
#[case::another_servers_authority(Has { ca: "strangers.pem", ..ALL }, "R", "no trusted authority")]
#[case::no_certificate(Has { cert: None, ..ALL }, "R", "asks for a client's certificate; set PERTURB_CERT")]
#[case::wrong_certificate(Has { cert: Some("stranger"), ..ALL }, "R", "accepts no client with the certificate")]
#[case::expired_certificate(Has { cert: Some("old"), ..ALL }, "R", "the certificate of PERTURB_CERT has expired")]
#[case::no_token(Has { token: None, ..ALL }, "R", "requires a token")]
#[case::wrong_token(Has { token: Some("another"), ..ALL }, "R", "does not know the token")]
#[case::wrong_role(ALL, "E", "a token of the role \"train\" may not draw from")]
fn wrong_credentials_are_refused_at_once_with_the_reason(#[case] has: Has, #[case] version: &str, #[case] part: &str) {
    let guarded = Guarded::start();
    let refused = guarded.train(&guarded.address, "bad", version, has);
    let words = stderr(&refused);
    assert!(!refused.status.success(), "{words}");
    assert!(words.contains(part) && !words.contains("waiting for it"), "{words}");
    let trained = guarded.train(&guarded.address, "good", "R", ALL);
    assert!(trained.status.success(), "{}", stderr(&trained));
}

#[test]
fn a_server_whose_certificate_has_expired_is_not_trusted() {
    let guarded = Guarded::until(2021);
    let refused = guarded.train(&guarded.address, "bad", "R", ALL);
    let words = stderr(&refused);
    assert!(!refused.status.success(), "{words}");
    assert!(words.contains("has expired") && !words.contains("waiting for it"), "{words}");
}

#[rstest]
#[case::of_the_server(true, [100, 1_000, 5_000, 10_000, 20_000, 40_000])]
#[case::of_the_client(false, [100, 400, 2_000, 5_000, 20_000, 100_000])]
fn a_changed_byte_never_changes_what_is_learnt(#[case] is_servers: bool, #[case] places: [usize; 6]) {
    let guarded = Guarded::start();
    let trained = guarded.train(&guarded.address, "truth", "R", ALL);
    assert!(trained.status.success(), "{}", stderr(&trained));
    let truth = weights(&guarded.file("truth"));
    let mut reached = 0;
    let mut outlived = 0;
    for place in places {
        let fault = Some(ByteFault { at: place, kind: FaultKind::BitFlip });
        let course = move |number| {
            let fault = fault.filter(|_| number == 0); // only the first connection is faulty
            let [from_server, from_client] = if is_servers { [fault, None] } else { [None, fault] };
            FaultPlan { from_server, from_client, ..FaultPlan::default() }
        };
        let line = FaultyProxy::start(&guarded.address, course).expect("a port");
        let out = format!("at-{place}");
        let trained = guarded.train(&format!("https://{}", line.address()), &out, "R", ALL);
        println!("a byte changed at {place}: status {}, {}", trained.status, stderr(&trained).trim());
        if trained.status.success() {
            assert!(weights(&guarded.file(&out)) == truth, "the changed byte at {place} changed the weights");
            outlived += line.faults();
        } else {
            assert!(line.faults() > 0, "nothing was wrong: {}", stderr(&trained));
        }
        reached += line.faults();
    }
    assert!(reached >= 3, "only {reached} faults happened");
    assert!(outlived > 0, "no training survived a fault");
}
