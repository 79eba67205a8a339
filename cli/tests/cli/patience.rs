//! Servers are killed and connections are cut at random moments. The results have the same bytes as without
//! interruptions.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use rstest::rstest;
use tempfile::TempDir;

use crate::common::{child_server, ended, kill, perturb, run, server, stderr, wait_for, wait_for_server};
use perturb_faults::{ByteFault, FaultKind, FaultPlan, FaultyProxy, SeededRng};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::Servers;

pub const PPO_CART_POLE: &str = "environment = 'CartPole'\nversion = 'R'\nalgorithm = 'ppo'\narchitecture = 'ff'\n\
                             episodes = 800\nnum_envs = 8\nn_steps = 64\ncheckpoint_interval = 20";
pub const A2C_PENDULUM: &str = "environment = 'Pendulum'\nversion = 'R'\nalgorithm = 'a2c'\narchitecture = 'ff'\n\
                                episodes = 400\nnum_envs = 8\ncheckpoint_interval = 8";

/// The server that is killed.
#[derive(Clone, Copy, Debug)]
enum Victim {
    /// The private server, which the program restarts itself.
    Private,
    /// The only server of --server. The test restarts it.
    Named,
    /// One of the two servers of --server, at random. The test restarts it.
    OneOfTwo,
}

/// A server on a Unix socket. It can be killed and restarted.
pub struct Named {
    socket: PathBuf,
    child: Child,
}

impl Named {
    pub fn new(folder: &Path, name: &str) -> Self {
        let socket = folder.join(name);
        let child = Self::start(&socket);
        Self { socket, child }
    }

    fn start(socket: &Path) -> Child {
        let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
        let mut command = Command::new(program);
        command.arg("--listen").arg(format!("unix:{}", socket.display()));
        command.args(["--log", "error", "--workers", "1", "--exit-with-stdin"]);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().expect("perturb-server");
        wait_for_server(socket);
        child
    }

    pub fn address(&self) -> String {
        format!("unix:{}", self.socket.display())
    }

    /// Returns the id of the server's process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn kill(&mut self) {
        self.child.kill().and_then(|()| self.child.wait()).expect("killed");
    }

    pub fn restart(&mut self) {
        self.child = Self::start(&self.socket);
    }
}

impl Drop for Named {
    fn drop(&mut self) {
        let _ = self.child.kill(); // it may be killed already
        let _ = self.child.wait();
    }
}

/// Returns the policy's id, which contains the checksum of its weights, and the numbers of episodes and of steps.
pub fn result(run: &Path) -> (String, u64, u64) {
    let checkpoint = Checkpoint::load(run).expect("a checkpoint");
    let counters = checkpoint.state.counters;
    (checkpoint.id().expect("a name"), counters.episodes, counters.timesteps)
}

pub fn undisturbed(text: &str) -> (String, u64, u64) {
    let local = server(1);
    let servers = Servers::connect(std::slice::from_ref(local.address())).expect("a connection");
    let (out, _) = run(&servers, text);
    result(out.path())
}

/// Starts a training. Its messages go to a file.
pub fn train(folder: &TempDir, text: &str, arguments: &[&str]) -> (Child, PathBuf, PathBuf) {
    let (settings, out, said) =
        (folder.path().join("settings.toml"), folder.path().join("run"), folder.path().join("said"));
    std::fs::write(&settings, text).expect("written");
    let _ = std::fs::remove_dir_all(&out); // an earlier training may have used it
    let mut command = perturb(&["train", "--threads", "1"]);
    command.arg("--config").arg(settings).arg("--out").arg(&out).args(arguments);
    let child = command.stderr(File::create(&said).expect("a file")).spawn().expect("started");
    (child, out, said)
}

/// Trains while servers are killed. Returns the number of kills and the result.
fn harassed(text: &str, victim: Victim, most: usize, dice: &mut SeededRng) -> (usize, (String, u64, u64)) {
    let folder = tempfile::tempdir().expect("a directory");
    let names: &[&str] = match victim {
        Victim::Private => &[],
        Victim::Named => &["a"],
        Victim::OneOfTwo => &["a", "b"],
    };
    let mut named: Vec<Named> = names.iter().map(|name| Named::new(folder.path(), name)).collect();
    let list = named.iter().map(Named::address).collect::<Vec<_>>().join(",");
    let (mut child, out, said) = match victim {
        Victim::Private => train(&folder, text, &["--workers", "1"]),
        Victim::Named | Victim::OneOfTwo => train(&folder, text, &["--server", &list]),
    };
    // Wait for the training to begin. Before that, a server that does not answer counts as a wrong address and ends the
    // program.
    wait_for("a training", || out.join("progress.csv").exists());
    let mut kills = 0;
    while kills < most {
        if child.try_wait().expect("a child").is_some() {
            break;
        }
        if named.is_empty() {
            let Some(id) = child_server(child.id()) else {
                dice.wait(0, 50);
                continue;
            };
            let _ = Command::new("kill").args(["-KILL", &id.to_string()]).status(); // it may have ended
        } else {
            let place = dice.below(named.len() as u64) as usize;
            named[place].kill();
            dice.wait(0, 300);
            named[place].restart();
        }
        kills += 1;
        dice.wait(0, 500);
    }
    let status = child.wait().expect("ended");
    let said = std::fs::read_to_string(said).expect("words");
    assert!(status.success(), "{status}: {said}");
    if named.is_empty() && kills > 1 {
        // The program restarts its private server without waiting.
        assert!(said.contains("; starting it again") && !said.contains("waiting for it"), "{said}");
    }
    (kills, result(&out))
}

#[rstest]
#[case(PPO_CART_POLE, Victim::Private)]
#[case(PPO_CART_POLE, Victim::OneOfTwo)]
#[case(A2C_PENDULUM, Victim::Named)]
#[case(A2C_PENDULUM, Victim::OneOfTwo)]
fn a_training_gives_same_weights_after_servers_restart(#[case] text: &str, #[case] victim: Victim) {
    let (kills, got) = harassed(text, victim, 3, &mut SeededRng::new());
    assert!(kills > 0, "it ended before anything was killed");
    assert_eq!(got, undisturbed(text), "after {kills} kills");
}

/// A server at a free TCP port.
struct AtPort {
    child: Child,
    address: String,
}

impl AtPort {
    fn new() -> Self {
        let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
        let mut command = Command::new(program);
        command.args(["--listen", "tcp://127.0.0.1:0", "--log", "error", "--workers", "1", "--exit-with-stdin"]);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("perturb-server");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("its output")).read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on http://").expect("an address").to_owned();
        Self { child, address }
    }
}

impl Drop for AtPort {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[rstest]
#[case::the_server_acts(PPO_CART_POLE, &[])]
#[case::the_learner_acts(A2C_PENDULUM, &["--act", "client"])]
fn a_training_over_breaking_lines_needs_no_checkpoint(#[case] text: &str, #[case] arguments: &[&str]) {
    let mut dice = SeededRng::new();
    let folder = tempfile::tempdir().expect("a directory");
    let server = AtPort::new();
    // The first connection is closed only after 300 kB, because the client reads the server's catalogue over it and
    // then begins the training. Later connections are closed earlier.
    let course = move |number: usize| {
        let at = if number == 0 { 300_000 } else { dice.below(100_000) as usize };
        FaultPlan { from_server: Some(ByteFault { at, kind: FaultKind::Close }), ..FaultPlan::default() }
    };
    let line = FaultyProxy::start(&server.address, course).expect("a line");
    let address = line.address();
    let arguments = [&["--server", &address], arguments].concat();
    let (child, out, said) = train(&folder, text, &arguments);
    let status = ended(child).status;
    let said = std::fs::read_to_string(said).expect("words");
    assert!(status.success(), "{status}: {said}");
    assert!(!said.contains("waiting for it"), "it resumed from a checkpoint: {said}");
    assert!(said.contains("resumed the session"), "the resumed session was not reported: {said}");
    assert!(line.faults() >= 5, "{} cuts", line.faults());
    assert_eq!(result(&out), undisturbed(text), "after {} cuts", line.faults());
}

/// The test takes some minutes, so only `make kill-test` runs it.
#[test]
#[ignore = "takes minutes"]
fn a_hundred_kills_change_no_weight() {
    let mut dice = SeededRng::new();
    for text in [PPO_CART_POLE, A2C_PENDULUM] {
        let expected = undisturbed(text);
        for victim in [Victim::Private, Victim::Named, Victim::OneOfTwo] {
            let mut kills = 0;
            let mut trainings = 0;
            while kills < 17 {
                let (more, got) = harassed(text, victim, 17 - kills, &mut dice);
                (kills, trainings) = (kills + more, trainings + 1);
                assert_eq!(got, expected, "{victim:?}, training {trainings}");
            }
            println!("{victim:?}: {kills} kills in {trainings} trainings, all {}", expected.0);
        }
    }
}

#[test]
fn a_training_continues_without_a_lost_server() {
    let folder = tempfile::tempdir().expect("a directory");
    let mut two = ["a", "b"].map(|name| Named::new(folder.path(), name));
    let list = two.iter().map(Named::address).collect::<Vec<_>>().join(",");
    let (mut child, out, said) = train(&folder, A2C_PENDULUM, &["--server", &list]);
    wait_for("a training", || out.join("checkpoint/checkpoint.json").exists());
    two[0].kill();
    let status = child.wait().expect("ended");
    let said = std::fs::read_to_string(said).expect("words");
    assert!(status.success(), "{said}");
    assert!(said.contains(&format!("lost the server at {} ", two[0].address())), "{said}");
    assert!(said.contains(&format!("going on with {} alone", two[1].address())), "{said}");
    assert_eq!(result(&out), undisturbed(A2C_PENDULUM));
}

#[test]
fn a_signal_ends_a_waiting_training_with_a_resume_hint() {
    let folder = tempfile::tempdir().expect("a directory");
    let mut one = Named::new(folder.path(), "a");
    let (mut child, out, said) = train(&folder, A2C_PENDULUM, &["--server", &one.address()]);
    wait_for("a checkpoint", || out.join("checkpoint/checkpoint.json").exists());
    one.kill();
    let words = || std::fs::read_to_string(&said).expect("words");
    wait_for("a waiting training", || words().contains("; waiting for it, at most 15 min"));
    assert!(child.try_wait().expect("a child").is_none(), "{}", words());
    kill("-INT", child.id());
    assert_eq!(child.wait().expect("ended").code(), Some(130), "{}", words());
    let command = format!("perturb train --resume {} --server {}", out.display(), one.address());
    assert!(words().contains("stopped by signal 2 while waiting for a server: lost the server"), "{}", words());
    assert!(words().trim_end().ends_with(&command), "{}", words());
}

#[test]
fn a_test_outlives_its_server() {
    let folder = tempfile::tempdir().expect("a directory");
    let (mut child, out, said) = train(&folder, &A2C_PENDULUM.replace("= 400", "= 16"), &[]);
    assert!(child.wait().expect("ended").success(), "{}", std::fs::read_to_string(said).expect("words"));
    let mut command =
        perturb(&["evaluate", "--versions", "D,E", "--episodes", "12000", "--json", "-", "--workers", "1"]);
    command.arg("--checkpoint").arg(out);
    let start = Instant::now();
    let whole = command.output().expect("ended");
    let time = start.elapsed();
    assert!(whole.status.success(), "{}", stderr(&whole));
    let child = command.spawn().expect("started");
    let mut victim = None;
    wait_for("a server", || {
        victim = child_server(child.id());
        victim.is_some()
    });
    // After a third of the measured time, the client is connected and in the middle of its work on any machine.
    std::thread::sleep(time / 3);
    kill("-KILL", victim.expect("a server"));
    let broken = ended(child);
    assert!(broken.status.success(), "{}", stderr(&broken));
    assert!(stderr(&broken).contains("the private server ended with signal: 9 (SIGKILL)"), "{}", stderr(&broken));
    assert_eq!(broken.stdout, whole.stdout);
}
