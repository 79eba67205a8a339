//! Trainings with the same seed give the same weights on every x86-64 processor. Server and learner run on this
//! machine's processor, and on qemu's models of older processors: Nehalem without AVX, and Haswell with AVX2 and FMA.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use rstest::rstest;

use crate::common::{stderr, wait_for_server};

/// Environment variable that decides about a missing qemu. If it is set, the test fails. If it is not set, the test is
/// skipped.
const REQUIRED: &str = "PERTURB_QEMU_REQUIRED";
const QEMU: &str = "qemu-x86_64";

/// Returns a command that runs `program` on a processor model of qemu, or on this machine's processor if `processor` is
/// `None`.
fn on(processor: Option<&str>, program: &Path) -> Command {
    let Some(processor) = processor else { return Command::new(program) };
    let mut command = Command::new(QEMU);
    command.args(["-cpu", processor]).arg(program);
    command
}

/// A process that ends when this value is dropped.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Trains with `arguments` and returns the bytes of the weights' file.
fn weights(processor: Option<&str>, arguments: &[&str]) -> Vec<u8> {
    let directory = tempfile::tempdir().expect("a directory");
    let socket = directory.path().join("socket");
    let out = directory.path().join("run");
    let learner = Path::new(env!("CARGO_BIN_EXE_perturb"));
    let address = format!("unix:{}", socket.display());
    let mut server = on(processor, &learner.with_file_name("perturb-server"));
    server.args(["--workers", "1", "--listen", &address]).stdout(Stdio::null()).stderr(Stdio::null());
    let _server = Server(server.spawn().expect("a server"));
    wait_for_server(&socket);
    let mut train = on(processor, learner);
    train.args(["train", "--seed", "3", "--threads", "2", "--server", &address, "--out"]).arg(&out).args(arguments);
    let output = train.output().expect("a training");
    assert!(output.status.success(), "{processor:?} {arguments:?}: {}", stderr(&output));
    let entries = out.join("checkpoint").read_dir().expect("a checkpoint");
    let is_weights =
        |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("weights-"));
    let path = entries.map(|entry| entry.expect("an entry").path()).find(is_weights).expect("weights");
    std::fs::read(path).expect("weights")
}

#[rstest]
fn every_processor_learns_the_same_weights(
    #[values("CartPole", "Pendulum")] environment: &str,
    #[values(
        &["--algorithm", "a2c", "--episodes", "24"],
        &["--algorithm", "ppo", "--episodes", "16", "--set", "n_steps=64", "--set", "n_minibatches=4"],
        &["--algorithm", "epopt-ppo", "--episodes", "12", "--set", "episodes_per_iteration=8", "--set", "num_envs=8"],
    )]
    algorithm: &[&str],
) {
    let status = Command::new(QEMU).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !status.is_ok_and(|status| status.success()) {
        assert!(std::env::var_os(REQUIRED).is_none(), "{QEMU} is missing: install qemu-user");
        eprintln!("skipped: {QEMU} is missing (Debian's package qemu-user); `make qemu-test` installs it");
        return;
    }
    let arguments = [&["--env", environment, "--version", "R"], algorithm].concat();
    let native = weights(None, &arguments);
    for processor in ["Nehalem", "Haswell"] {
        assert!(weights(Some(processor), &arguments) == native, "{processor} learns other weights");
    }
}
