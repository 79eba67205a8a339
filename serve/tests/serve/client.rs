//! A fixture: a folder of runs, a server that shows it, and a client that sends raw requests.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use perturb_checkpoint::Counters;
use perturb_experiment::{CellResult, ExperimentFolder, Plan, Training};
use perturb_records::TestResult;
use perturb_serve::{ServeOptions, Server};
use perturb_settings::TrainConfig;
use tempfile::TempDir;

/// Upper bound of every wait. It is long because the machine may be busy.
pub const LIMIT: Duration = Duration::from_secs(60);
pub const MONITOR: &str = "#{\"t_start\": 1}\nr,l,t,success,terminated\n";
const PLAN: &str =
    "environments = ['CartPole']\nversions = ['D', 'R']\ntest_versions = ['D', 'R', 'E']\ntest_episodes = 10
    settings = { episodes = 100 }\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\n";

/// A folder of runs, and a server that shows it.
pub struct Place {
    pub folder: TempDir,
    pub address: SocketAddr,
}

/// An HTTP response. `head` is in lower case.
pub struct Answer {
    pub status: u16,
    pub head: String,
    pub body: String,
}

impl Place {
    /// Makes `outside.csv`, and beside it `runs/` with a training `one`, an experiment `study` and a picture.
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let runs = folder.path().join("runs");
        write(&folder.path().join("outside.csv"), "secret");
        write_training(&runs.join("one"), 30);
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let study = ExperimentFolder::new(&runs.join("study"));
        study.store_plan(&plan).unwrap();
        study.cell(&plan.cells[0].id).write_result(&result(&plan.cells[0])).unwrap();
        write(&runs.join("pictures/over <b>.svg"), "<svg xmlns='http://www.w3.org/2000/svg'/>");
        let address = serve(&runs);
        Self { folder, address }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join("runs").join(name)
    }

    /// Sends a GET request as a browser of this machine does.
    pub fn get(&self, path: &str) -> Answer {
        self.ask("GET", path, "localhost")
    }

    /// Repeats a request until the response satisfies `wanted`, because pages may be a second old.
    #[track_caller]
    pub fn until(&self, path: &str, wanted: impl Fn(&Answer) -> bool) -> Answer {
        let start = Instant::now();
        loop {
            let answer = self.get(path);
            if wanted(&answer) {
                return answer;
            }
            assert!(start.elapsed() < LIMIT, "{path} is still {} {}", answer.status, answer.body);
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    pub fn ask(&self, method: &str, path: &str, host: &str) -> Answer {
        self.send(&format!("{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"))
    }

    pub fn send(&self, request: &str) -> Answer {
        let mut stream = connect(self.address);
        stream.write_all(request.as_bytes()).unwrap();
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).unwrap();
        let text = String::from_utf8_lossy(&bytes);
        let (head, body) = text.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no answer to {request:?}: {text:?}"));
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Answer { status, head: head.to_ascii_lowercase(), body: body.to_owned() }
    }

    pub fn events(&self, path: &str) -> Events {
        let mut stream = connect(self.address);
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        Events(BufReader::new(stream))
    }
}

/// An open event stream.
pub struct Events(BufReader<TcpStream>);

impl Events {
    /// Returns the next event that satisfies `wanted`.
    #[track_caller]
    pub fn until(&mut self, what: &str, wanted: impl Fn(&serde_json::Value) -> bool) -> serde_json::Value {
        let start = Instant::now();
        let mut line = String::new();
        loop {
            line.clear();
            assert!(self.0.read_line(&mut line).unwrap() > 0, "the stream ended before {what}");
            if let Some(data) = line.strip_prefix("data: ") {
                let event: serde_json::Value = serde_json::from_str(data.trim_end()).unwrap();
                if wanted(&event) {
                    return event;
                }
            }
            assert!(start.elapsed() < LIMIT, "{what} did not happen; the last line is {line}");
        }
    }

    /// Returns the status code of the response.
    pub fn status(&mut self) -> String {
        let mut line = String::new();
        self.0.read_line(&mut line).unwrap();
        line.split(' ').nth(1).unwrap_or_default().to_owned()
    }
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    stream
}

/// Serves `folder` until the test program ends.
pub fn serve(folder: &Path) -> SocketAddr {
    let options = ServeOptions {
        folder: folder.to_owned(),
        address: ([127, 0, 0, 1], 0).into(),
        hosts: Vec::new(),
        server: None,
    };
    let (sender, receiver) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let server = Server::bind(&options).await.unwrap();
            sender.send(server.address()).unwrap();
            server.run().await;
        });
    });
    receiver.recv().unwrap()
}

pub fn write(path: &Path, content: &str) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, content).unwrap();
}

/// Writes the files of a training with this number of episodes in `monitor.csv`. Half of them are successes, and the
/// returns are 0, 1, 2, … The line in `progress.csv` always has 30 episodes.
pub fn write_training(path: &Path, episodes: usize) {
    let text = "environment = 'CartPole'\nalgorithm = 'a2c'\nepisodes = 200";
    let config = TrainConfig::from_table("the test", text.parse().unwrap()).unwrap();
    write(&path.join("config.toml"), &config.to_toml());
    write(&path.join("monitor.csv"), &(MONITOR.to_owned() + &lines(0, episodes)));
    let progress = "time/total_timesteps,time/time_elapsed,time/acting,time/waiting,time/updating,rollout/episodes,\
                    rollout/ep_rew_mean,rollout/success_rate\n1234,10,1,2,5,30,14.5,0.5\n";
    write(&path.join("progress.csv"), progress);
}

/// Returns the lines of `monitor.csv` for the episodes `from` to `to - 1`.
pub fn lines(from: usize, to: usize) -> String {
    (from..to).map(|i| format!("{i},4,{}.0,{},1\n", i + 1, i % 2)).collect()
}

/// Returns a result of a cell with success rates of 91 % on D, 92 % on R and 93 % on E.
pub fn result(cell: &perturb_experiment::Cell) -> CellResult {
    let test = |(name, percent): (&str, f64)| {
        let result = TestResult {
            episodes: 10,
            success_percent: percent,
            success_percent_95: [percent - 1.0, percent + 1.0],
            mean_return: 7.0,
            mean_length: 8.0,
        };
        (name.to_owned(), result)
    };
    CellResult {
        format_version: 1,
        id: cell.id.clone(),
        training: Training {
            environment: cell.config.common.environment.clone(),
            environment_revision: 0,
            model_hash: String::new(),
            version: cell.config.common.version,
            set: None,
            method: cell.method(),
            configuration: cell.configuration.clone(),
            run: cell.run,
            seed: cell.config.common.seed,
            counters: Counters::default(),
            settings: cell.config.table(),
        },
        results: [("D", 91.0), ("R", 92.0), ("E", 93.0)].map(test).into(),
        marks: Default::default(),
        agreement: None,
        commit: "the test".into(),
        earlier_commits: Vec::new(),
        command: "perturb train".into(),
    }
}
