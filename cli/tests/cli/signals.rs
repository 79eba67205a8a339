//! Signals end a training soon, even while it waits for something. The training saves a checkpoint.

use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use perturb_learner::checkpoint::Checkpoint;
use rstest::rstest;
use tempfile::TempDir;

use crate::common::{child_server, ended, kill, perturb, stderr, wait_for};
use crate::patience::{Named, train};

/// Maximum time from the signal to the end of the program, in seconds, on a busy machine. If the signal were not
/// handled, it would be a minute or more.
const MAX_SECONDS: f64 = 20.0;
const SETTINGS: &str =
    "environment = 'CartPole'\nalgorithm = 'ppo'\narchitecture = 'ff'\nepisodes = 1000000\nseed = 1\n";
/// Settings with rollouts that take a moment and updates that take minutes.
const LONG_UPDATES: &str = "n_epochs = 1000\nn_steps = 2048\n";

/// Sends SIGTERM, waits for the end of the program, and checks that it came within [`MAX_SECONDS`].
#[track_caller]
fn terminated(child: Child) -> Output {
    let start = Instant::now();
    kill("-TERM", child.id());
    let output = ended(child);
    let seconds = start.elapsed().as_secs_f64();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(143), "{said}");
    assert!(seconds < MAX_SECONDS, "{seconds} s: {said}");
    output
}

fn progress(out: &Path) -> bool {
    std::fs::read_to_string(out.join("progress.csv")).is_ok_and(|text| text.lines().count() > 2)
}

#[rstest]
#[case::train(&["train", "--env", "CartPole", "--algorithm", "a2c"])]
#[case::demo(&["demo"])]
fn a_server_that_does_not_answer_is_not_waited_for(#[case] arguments: &[&str]) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port"); // it accepts nothing
    let address = listener.local_addr().expect("an address").to_string();
    let folder = tempfile::tempdir().expect("a directory");
    let mut command = perturb(arguments);
    command.args(["--server", &address, "--out"]).arg(folder.path().join("run"));
    let child = command.spawn().expect("started");
    std::thread::sleep(Duration::from_millis(500));
    let output = terminated(child);
    assert!(stderr(&output).contains("stopped by signal 15 while connecting"), "{}", stderr(&output));
}

#[rstest]
#[case::named(true)]
#[case::private(false)]
fn a_server_that_stands_still_is_not_waited_for(#[case] named: bool) {
    let folder = tempfile::tempdir().expect("a directory");
    let server = named.then(|| Named::new(folder.path(), "socket"));
    let address = server.as_ref().map(Named::address);
    let arguments = address.as_ref().map_or(vec!["--workers", "1"], |address| vec!["--server", address]);
    let (child, out, said) = train(&folder, SETTINGS, &arguments);
    wait_for("progress", || progress(&out));
    let id = server.as_ref().map_or_else(|| child_server(child.id()).expect("a private server"), Named::id);
    kill("-STOP", id);
    std::thread::sleep(Duration::from_millis(300));
    terminated(child);
    let said = std::fs::read_to_string(said).expect("messages");
    assert!(said.contains("stopped by signal 15 while waiting for the server at"), "{said}");
    if named {
        kill("-CONT", id);
    }
}

#[test]
fn a_lost_server_is_not_waited_for() {
    let folder = tempfile::tempdir().expect("a directory");
    let mut server = Named::new(folder.path(), "socket");
    let (child, out, said) = train(&folder, SETTINGS, &["--server", &server.address()]);
    wait_for("progress", || progress(&out));
    server.kill();
    wait_for("the wait", || std::fs::read_to_string(&said).is_ok_and(|said| said.contains("waiting for it")));
    terminated(child);
}

#[test]
fn a_long_update_is_broken_off() {
    let folder = tempfile::tempdir().expect("a directory");
    let (child, out, said) = train(&folder, &format!("{SETTINGS}{LONG_UPDATES}"), &["--workers", "1"]);
    wait_for("a training", || out.join("monitor.csv").exists());
    std::thread::sleep(Duration::from_secs(3)); // until the first update, after a rollout
    terminated(child);
    let said = std::fs::read_to_string(said).expect("messages");
    assert!(said.contains("stopped by signal 15 during an update"), "{said}");
}

/// Starts a training, waits for its first progress, and sends it a signal. Returns the process and the training's
/// folder.
fn signalled(signal: &str, prepare: impl FnOnce(&mut Command)) -> (Child, TempDir) {
    let folder = tempfile::tempdir().expect("a directory");
    let mut command = perturb(&["train", "--env", "CartPole", "--algorithm", "a2c", "--seed", "1"]);
    command.args(["--episodes", "1000000", "--set", "checkpoint_interval=1000000", "--out"]).arg(folder.path());
    prepare(&mut command);
    let child = command.spawn().expect("started");
    wait_for("progress", || progress(folder.path()));
    kill(signal, child.id());
    (child, folder)
}

#[rstest]
#[case::hangup("-HUP", 1)]
#[case::user_1("-USR1", 10)]
#[case::user_2("-USR2", 12)]
#[case::processor_time("-XCPU", 24)]
#[case::terminate("-TERM", 15)]
fn every_signal_saves_a_checkpoint(#[case] signal: &str, #[case] number: i32) {
    let (child, folder) = signalled(signal, |command| {
        // The tests may run in a shell that ignores SIGHUP, which programs inherit. `env` ends that for this program.
        let program = command.get_program().to_owned();
        let arguments: Vec<_> = command.get_args().map(ToOwned::to_owned).collect();
        *command = Command::new("env");
        command.arg("--default-signal=HUP").arg(program).args(arguments);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    });
    if number != 15 {
        // Terminals and kernels may repeat these signals. A second SIGTERM would end the program immediately.
        let _ = Command::new("kill").args([signal, &child.id().to_string()]).status();
    }
    let output = ended(child);
    assert_eq!(output.status.code(), Some(128 + number), "{}", stderr(&output));
    let saved = Checkpoint::load(folder.path()).expect("a checkpoint").state.counters.iterations;
    let log = std::fs::read_to_string(folder.path().join("progress.csv")).expect("a log");
    let logged = log.lines().last().and_then(|line| line.split(',').next()?.parse::<f64>().ok());
    assert!(logged.is_some_and(|logged| saved as f64 >= logged), "{saved} saved, {logged:?} logged");
}

#[test]
fn a_hangup_that_nohup_ignores_ends_nothing() {
    let (mut child, _folder) = signalled("-HUP", |command| {
        // The program inherits from this shell that the signal is ignored.
        let program = command.get_program().to_owned();
        let arguments: Vec<_> = command.get_args().map(ToOwned::to_owned).collect();
        *command = Command::new("sh");
        command.args(["-c", "trap '' HUP; exec \"$@\"", "sh"]).arg(program).args(arguments);
        command.process_group(0);
    });
    std::thread::sleep(Duration::from_millis(500));
    assert!(child.try_wait().expect("a child").is_none(), "it goes on");
    kill("-TERM", child.id());
    child.wait().expect("an end");
}
