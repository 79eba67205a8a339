//! Proofs by a server's ledger that a training did not use its test sets.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use tempfile::TempDir;

use crate::common::{ended, perturb, stderr};

const TOKENS: &str = r#"
[[token]]
name = "trainer"
token = "correct-horse-battery"
role = "train"

[[token]]
name = "tester"
token = "staple-horse-battery"

[[role]]
name = "train"
draws = ["D", "R"]
"#;

/// A server that requires tokens and writes a ledger.
struct Kept {
    server: Child,
    directory: TempDir,
    address: String,
}

impl Kept {
    fn start() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let file = |name: &str, text: &str| std::fs::write(directory.path().join(name), text).expect("written");
        file("tokens.toml", TOKENS);
        file("trainer", "correct-horse-battery");
        file("tester", "staple-horse-battery");
        let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
        let mut server = Command::new(program)
            .current_dir(directory.path())
            .args(["--listen", "tcp://127.0.0.1:0", "--tokens", "tokens.toml", "--ledger", "ledger"])
            .args(["--workers", "1", "--log", "error"])
            .stdout(Stdio::piped())
            .spawn()
            .expect("perturb-server");
        let mut line = String::new();
        BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
        Self { server, directory, address }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Runs `perturb` with a token.
    fn run(&self, token: &str, arguments: &[&str]) -> Output {
        let mut command = perturb(arguments);
        command.args(["--server", &self.address, "--server-wait", "0"]).current_dir(self.directory.path());
        command.env("PERTURB_TOKEN_FILE", self.file(token));
        ended(command.stdout(Stdio::piped()).spawn().expect("perturb"))
    }

    fn train(&self, token: &str, version: &str, out: &str) {
        self.train_with(token, &["--version", version], out);
    }

    fn train_with(&self, token: &str, options: &[&str], out: &str) {
        let arguments = ["train", "--env", "CartPole", "--algorithm", "ppo", "--architecture", "ff", "--seed", "4"];
        let trained = self.run(token, &[&arguments[..], options, &["--episodes", "60", "--out", out]].concat());
        assert!(trained.status.success(), "{}", stderr(&trained));
    }

    fn evaluate(&self, token: &str, policy: &str, seed: &str) -> Output {
        let records = format!("{policy}.parquet");
        self.run(
            token,
            &["evaluate", "--checkpoint", policy, "--episodes", "40", "--records", &records, "--seed", seed],
        )
    }

    /// Checks a policy by the ledger. Returns whether it is clean, and the messages.
    fn audit(&self, policy: &str, more: &[&str]) -> (bool, String) {
        let records = format!("{policy}.parquet");
        let audited =
            self.run("tester", &[&["audit", &records, "--checkpoint", policy, "--ledger", "ledger"], more].concat());
        (audited.status.success(), format!("{}{}", String::from_utf8_lossy(&audited.stdout), stderr(&audited)))
    }
}

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

#[test]
fn a_ledger_proves_training_apart_from_test_sets() {
    let kept = Kept::start();
    kept.train("trainer", "D", "policy");
    let cheating = kept.evaluate("trainer", "policy", "8");
    assert!(!cheating.status.success() && stderr(&cheating).contains("may not draw from"), "{}", stderr(&cheating));
    let tested = kept.evaluate("tester", "policy", "8");
    assert!(tested.status.success(), "{}", stderr(&tested));
    let (clean, words) = kept.audit("policy", &[]);
    assert!(clean && words.contains("the training was drawn with \"trainer\" in 1 session"), "{words}");
    let head = words.split("--head ").nth(1).expect("the chain's end").trim();
    assert!(kept.audit("policy", &["--head", head]).0, "what was printed can be asked for");
    let (clean, words) = kept.audit("policy", &["--head", &head.replace(|digit: char| digit.is_ascii_digit(), "x")]);
    assert!(!clean && words.contains("no line has the digest"), "{words}");

    // The token `tester` drew from E in the test above, before this training was finished.
    kept.train("tester", "R", "leaked");
    assert!(kept.evaluate("tester", "leaked", "9").status.success());
    let (clean, words) = kept.audit("leaked", &[]);
    assert!(!clean && words.contains("of the test set E, had been drawn before the training ended"), "{words}");
    assert!(words.contains("by the token \"tester\"") && !words.contains("\"trainer\""), "{words}");
    assert!(!words.contains("episodes of the test on"), "they have another seed: {words}");
    kept.train("tester", "R", "same");
    assert!(kept.evaluate("tester", "same", "9").status.success());
    let (clean, words) = kept.audit("same", &[]);
    assert!(!clean && words.contains("episodes of the test on R had been drawn before the training ended"), "{words}");
    let (clean, words) = kept.audit("policy", &["--json"]);
    let document: serde_json::Value = serde_json::from_str(&words).expect("JSON");
    assert!(clean && document["policies"][0]["tokens"][0] == "trainer", "{document:#}");
    let refused = document["policies"][0]["refused"].as_array().expect("a list");
    assert!(refused.is_empty(), "it came after the training: {refused:?}");

    let ledger = std::fs::read_to_string(kept.file("ledger")).expect("read");
    assert!(ledger.contains("\"event\":\"refused\"") && ledger.contains("\"token\":\"trainer\""), "{ledger}");
    std::fs::write(kept.file("ledger"), ledger.replacen("trainer", "another", 1)).expect("written");
    let (clean, words) = kept.audit("policy", &[]);
    assert!(!clean && words.contains("line 2 of ledger") && words.contains("was changed"), "{words}");
}

#[test]
fn ledger_proves_which_contexts_a_training_had() {
    let kept = Kept::start();
    std::fs::write(kept.file("own.csv"), "length,mass\n0.3,0.1\n0.5,0.2\n0.7,0.3\n").expect("written");
    let contexts = ["--version", "R", "--contexts", "own.csv"];
    kept.train_with("trainer", &contexts, "policy");
    assert!(kept.evaluate("tester", "policy", "8").status.success());
    let (clean, words) = kept.audit("policy", &[]);
    assert!(clean && words.contains("the training was drawn with \"trainer\" in 1 session"), "{words}");

    // The ledger of a training on other contexts does not prove it.
    let other = Kept::start();
    std::fs::write(other.file("own.csv"), "length,mass\n0.3,0.1\n0.5,0.2\n").expect("written");
    other.train_with("trainer", &contexts, "policy");
    std::fs::copy(other.file("ledger"), kept.file("other")).expect("copied");
    let arguments = ["audit", "policy.parquet", "--checkpoint", "policy", "--ledger", "other"];
    let audited = kept.run("tester", &arguments);
    let words = String::from_utf8_lossy(&audited.stdout);
    assert!(!audited.status.success() && words.contains("record only 0 of the"), "{words}");
    assert!(words.contains("trained on R with 3 contexts of length, mass"), "{words}");
}
