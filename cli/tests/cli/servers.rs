//! Experiments over several servers.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Child;

use perturb_experiment::{ExperimentFolder, Plan};
use perturb_files::interrupt::StopFlag;
use perturb_learner::client::{Address, ClientSession, OpenOptions, Servers};
use perturb_protocol::Version;

use crate::common::{addresses, ended, kill, perturb, server, stderr, wait_for};

/// A plan with four cells of some seconds.
const PLAN: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['E']
test_versions = ['D', 'E']
test_episodes = 12
settings = { episodes = 100, num_envs = 8, checkpoint_interval = 5 }

[[algorithm]]
name = 'a2c'
architectures = ['ff']
grid = { learning_rate = [7e-3, 7e-4] }
";

/// A folder with runs of [`PLAN`].
struct Runs {
    directory: tempfile::TempDir,
    plan: Plan,
}

impl Runs {
    fn new() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        std::fs::write(directory.path().join("plan.toml"), PLAN).expect("written");
        Self { directory, plan: Plan::parse("plan.toml", PLAN.into()).unwrap_or_else(|error| panic!("{error}")) }
    }

    fn out(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn start(&self, name: &str, servers: &[Address]) -> Child {
        let list = servers.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
        let mut command = perturb(&["run", "--jobs", "2", "--server", &list]);
        command.arg(self.directory.path().join("plan.toml")).arg("--out").arg(self.out(name)).spawn().expect("started")
    }

    /// Returns the content of a file of every cell, by the cell's id; `None` if the file is missing.
    fn files(&self, name: &str, file: &str) -> BTreeMap<String, Option<String>> {
        let folder = ExperimentFolder::new(&self.out(name));
        let read = |id: &str| std::fs::read_to_string(folder.cell(id).path().join(file)).ok();
        self.plan.cells.iter().map(|cell| (cell.id.clone(), read(&cell.id))).collect()
    }
}

#[track_caller]
fn succeeded(run: Child) {
    let output = ended(run);
    assert!(output.status.success(), "{}: {}", output.status, stderr(&output));
}

fn options() -> OpenOptions {
    OpenOptions {
        environment: "CartPole".into(),
        version: Version::D,
        parameters: Default::default(),
        contexts: Vec::new(),
        num_envs: 2,
        seed: 1,
        episodes_per_trial: 1,
        observe: Default::default(),
    }
}

fn first(servers: &Servers) -> Address {
    servers.addresses().into_iter().next().expect("a connection")
}

/// Starts a server that accepts connections and never answers.
fn silent() -> (TcpListener, Address) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = listener.local_addr().expect("an address").to_string().parse().expect("an address");
    (listener, address)
}

/// Starts a server and a session, begins the server's shutdown, and calls `with_session`. The open session keeps the
/// server from ending.
fn shutting_down(with_session: impl FnOnce(&Address)) {
    let directory = tempfile::tempdir().expect("a directory");
    let socket = directory.path().join("socket");
    let address: Address = format!("unix:{}", socket.display()).parse().expect("an address");
    // The test starts perturb-server itself, because a private server would end too soon.
    let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
    let mut server = std::process::Command::new(program)
        .args(["--listen", &address.to_string(), "--log", "error", "--grace-seconds", "120"])
        .stdout(std::process::Stdio::null())
        .spawn()
        .expect("perturb-server");
    wait_for("the server", || Servers::connect(std::slice::from_ref(&address)).is_ok());
    let servers = Servers::connect(std::slice::from_ref(&address)).expect("a connection");
    let session = ClientSession::open(&servers, &options(), &mut Vec::new()).expect("a session");
    kill("-TERM", server.id());
    wait_for("the beginning of the end", || Servers::connect(std::slice::from_ref(&address)).is_err());
    with_session(&address);
    drop(session);
    drop(servers);
    server.wait().expect("it ends with its last session");
}

#[test]
fn a_run_uses_all_servers_and_survives_a_lost_one() {
    let runs = Runs::new();
    let mut servers = vec![server(1), server(1)];
    let both = addresses(&servers);
    succeeded(runs.start("whole", &both[..1]));
    let whole = runs.files("whole", "result.json");
    assert!(whole.values().all(Option::is_some));

    let run = runs.start("broken", &both);
    // Cells 0 and 1 begin first. Cell 0 runs on the first server.
    wait_for("a training on each server", || {
        let trainings = runs.files("broken", "training/progress.csv");
        runs.plan.cells[..2].iter().all(|cell| trainings[&cell.id].is_some())
    });
    kill("-KILL", servers[0].process_id());
    drop(servers.remove(0));
    succeeded(run);
    assert_eq!(runs.files("broken", "result.json"), whole);

    let again = ended(runs.start("broken", &both));
    let words = stderr(&again);
    assert!(again.status.success(), "{words}");
    assert!(words.contains(&format!("no server answers at {}", both[0])), "the other server is enough: {words}");
    assert!(words.contains("continuing with the other servers"), "{words}");
}

#[test]
fn sessions_rotate_over_servers_that_accept_them() {
    let servers = [server(1), server(1)];
    let both = addresses(&servers);
    for turn in 0..4 {
        let one = Servers::connect_to_one(&both, turn, &StopFlag::default()).expect("a connection");
        assert_eq!(one.addresses(), [both[turn % 2].clone()]);
    }
    let (_listener, silent) = silent();
    let gone: Address = "unix:/nowhere/perturb.sock".parse().expect("an address");
    shutting_down(|ending| {
        let ending = ending.clone();
        let three = [ending.clone(), silent.clone(), both[0].clone()];
        let (some, troubles) = Servers::connect_to_some(&three, &StopFlag::default()).expect("a connection");
        assert_eq!(some.addresses(), [both[0].clone()]);
        let words: Vec<String> = troubles.iter().map(ToString::to_string).collect();
        assert!(words[0].contains(&format!("{ending}: it is shutting down")), "{words:?}");
        assert!(words[1].contains(&format!("{silent}: it accepted the connection, but did not answer")), "{words:?}");
        for turn in 0..3 {
            let three = [ending.clone(), gone.clone(), both[0].clone()];
            assert_eq!(
                first(&Servers::connect_to_one(&three, turn, &StopFlag::default()).expect("a connection")),
                both[0]
            );
        }
        let error = Servers::connect_to_one(&[ending.clone(), gone.clone()], 0, &StopFlag::default())
            .expect_err("none")
            .to_string();
        assert!(error.contains("it is shutting down; unix:/nowhere/perturb.sock: "), "{error}");
        let error = Servers::connect_to_one(&[ending], 0, &StopFlag::default()).expect_err("one").to_string();
        assert!(error.starts_with("no server answers at unix:"), "{error}");
    });
}

#[test]
fn a_name_is_one_server_however_many_addresses_it_has() {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = listener.local_addr().expect("an address").port();
    drop(listener);
    let directory = tempfile::tempdir().expect("a directory");
    let program = Path::new(env!("CARGO_BIN_EXE_perturb")).with_file_name("perturb-server");
    let mut child = std::process::Command::new(program)
        .args(["--listen", &format!("tcp://127.0.0.1:{port}"), "--exit-with-stdin", "--log", "error"])
        .stdin(std::process::Stdio::piped())
        .stdout(std::fs::File::create(directory.path().join("out")).expect("a file"))
        .spawn()
        .expect("perturb-server");
    wait_for("the server", || std::fs::read(directory.path().join("out")).is_ok_and(|text| !text.is_empty()));
    // localhost may also mean ::1, where no server listens.
    let name: Address = format!("localhost:{port}").parse().expect("an address");
    for turn in 0..3 {
        let one =
            Servers::connect_to_one(std::slice::from_ref(&name), turn, &StopFlag::default()).expect("a connection");
        ClientSession::open(&one, &options(), &mut Vec::new()).expect("a session");
    }
    assert_eq!(Servers::connect(&[name.clone(), name]).expect("connections").addresses().len(), 2);
    drop(child.stdin.take());
    child.wait().expect("it ends");
}
