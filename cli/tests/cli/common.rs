//! Helpers of several tests that run the programs.

use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_learner::client::{Address, PrivateServer, Servers};
use perturb_learner::training::{RunDirectory, TrainOutcome, train};
use perturb_settings::TrainConfig;
use tempfile::TempDir;

/// Upper bound of every wait. It is long because the machine may be busy.
pub const LIMIT: Duration = Duration::from_secs(300);

pub fn server(workers: usize) -> PrivateServer {
    perturb_torch::register(); // trainings of this process may use the server for recurrent policies
    PrivateServer::start(Some(workers)).unwrap_or_else(|error| panic!("{error}"))
}

pub fn addresses(servers: &[PrivateServer]) -> Vec<Address> {
    servers.iter().map(|server| server.address().clone()).collect()
}

pub fn config(text: &str) -> TrainConfig {
    perturb_torch::register();
    TrainConfig::from_table("the test", text.parse().expect("TOML")).unwrap_or_else(|error| panic!("{error}"))
}

/// Trains in a fresh directory.
pub fn run(servers: &Servers, text: &str) -> (TempDir, TrainOutcome) {
    let out = tempfile::tempdir().expect("a directory");
    let directory = RunDirectory::choose(out.path(), false).expect("an empty directory");
    let outcome = train(servers, &config(text), &directory, 2, &StopFlag::default(), |_| {});
    (out, outcome.unwrap_or_else(|error| panic!("{error:#}")))
}

pub fn perturb(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_perturb"));
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Runs a command that must be refused. Returns the command, its exit status and its messages, for a snapshot. `names`
/// has the texts that differ from run to run, each with its replacement.
#[track_caller]
pub fn refusal(arguments: &[&str], names: &[(&str, &str)]) -> String {
    let output = perturb(arguments).output().expect("perturb runs");
    let status = output.status.code().expect("it ends by itself");
    assert_ne!(status, 0, "{arguments:?} was not refused");
    let text = format!("perturb {}\nstatus {status}\n{}\n", arguments.join(" "), stderr(&output));
    names.iter().fold(text, |text, (long, name)| text.replace(long, name))
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Waits until a server accepts connections at `socket`. The existence of the file is not enough, because it exists a
/// moment earlier.
pub fn wait_for_server(socket: &Path) {
    wait_for("a server", || UnixStream::connect(socket).is_ok());
}

/// Waits until `condition` holds.
pub fn wait_for(what: &str, condition: impl FnMut() -> bool) {
    wait_within(LIMIT, what, condition);
}

/// Waits until `condition` holds, at most for `limit`.
pub fn wait_within(limit: Duration, what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < limit, "{what} did not happen within {limit:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Waits for the end of `child`. Kills it after the limit, so that a test fails instead of hanging.
#[track_caller]
pub fn ended(child: Child) -> Output {
    let id = child.id();
    let (done, watched) = channel::<()>();
    let watch = std::thread::spawn(move || {
        let is_late = watched.recv_timeout(LIMIT) == Err(RecvTimeoutError::Timeout);
        if is_late {
            kill("-KILL", id);
        }
        is_late
    });
    let output = child.wait_with_output().expect("its output");
    drop(done);
    assert!(!watch.join().expect("a watch"), "it did not end within {LIMIT:?}: {}", stderr(&output));
    output
}

/// Returns the process called perturb-server that `parent` started.
pub fn child_server(parent: u32) -> Option<u32> {
    let children = std::fs::read_to_string(format!("/proc/{parent}/task/{parent}/children")).ok()?;
    let is_server = |id: &u32| {
        std::fs::read_to_string(format!("/proc/{id}/comm")).is_ok_and(|name| name.trim().starts_with("perturb-serv"))
    };
    children.split_whitespace().filter_map(|id| id.parse().ok()).find(is_server)
}

/// Tells whether a process runs. Zombies do not run.
pub fn is_running(id: u32) -> bool {
    std::fs::read_to_string(format!("/proc/{id}/stat")).is_ok_and(|stat| !stat.contains(") Z "))
}

pub fn kill(signal: &str, id: u32) {
    let status = Command::new("kill").args([signal, &id.to_string()]).status().expect("kill");
    assert!(status.success());
}

pub fn read(directory: &Path, name: &str) -> String {
    std::fs::read_to_string(directory.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}
