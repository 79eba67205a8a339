//! What serving costs, each figure beside its yardstick of the same run:
//!
//! - CartPole, batch 256, over a Unix socket, against a bare tonic echo of the same payload;
//! - Hopper and HalfCheetah, batch 64, two workers, against twice the bare loop of the same model on one thread, and
//!   against two such threads at once, which is what the machine can give: in a closed loop, where each request waits for
//!   the reply to the last and the workers wait with it, and with two requests in flight, where they do not;
//! - the round trip of one environment, and the memory of one Hopper;
//! - pictures of each environment, 480 × 480 pixels, and what the server's memory grows by with them.
//!
//! Servers are processes of their own: `perturb-server`, and this program with the argument `echo` and a socket.

use bytes::Bytes;
use perturb::{
    env::{Action, ActionSpace, EnvironmentSpec, Episodes, Settings, Version},
    proto::{
        self, SessionRequest, SessionResponse,
        perturb_server::{Perturb, PerturbServer},
        session_request::Request as Ask,
        session_response::Response as Answer,
    },
    tasks,
};
use perturb_protocol::{Address, Connection, Stream as Session};
use std::{
    env as process_env, fs,
    io::{BufRead, BufReader},
    path::Path,
    pin::Pin,
    process::{Child, Command, Stdio},
    time::Instant,
};
use tokio::net::UnixListener;
use tokio_stream::{Stream, StreamExt, wrappers::UnixListenerStream};
use tonic::{Request, Response, Status, Streaming, transport::Server};

type Failure = Box<dyn std::error::Error>;

/// Yardstick and served loop take turns, in short rounds, so that a busy neighbour disturbs both; medians are printed.
const ROUNDS: usize = 25;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = process_env::args().collect();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    if let [_, kind, socket, ..] = arguments.as_slice()
        && kind == "echo"
    {
        return runtime.block_on(echo(socket.as_ref()));
    }
    // Cargo adds --bench; any other argument selects figures by a part of their name.
    let filter = arguments.iter().skip(1).find(|argument| !argument.starts_with('-'));
    let wanted = |id: &str| filter.is_none_or(|filter| id.contains(filter.as_str()));
    runtime.block_on(async {
        if wanted("step/CartPole/256") {
            classic().await?;
        }
        for name in tasks::catalogue().names().filter(|name| ["Hopper", "HalfCheetah"].contains(name)) {
            if wanted(&format!("step/{name}/64")) {
                locomotion(name).await?;
            }
        }
        if wanted("round_trip/CartPole/1") {
            round_trip().await?;
        }
        if wanted("memory/Hopper") {
            memory().await?;
        }
        for name in tasks::catalogue().names() {
            if wanted(&format!("render/{name}/480")) {
                pictures(name).await?;
            }
        }
        Ok(())
    })
}

/// (a) CartPole in batches of 256 against the echo.
async fn classic() -> Result<(), Failure> {
    const BATCH: usize = 256;
    const TRIPS: usize = 800;
    let (server, echo) = (Process::server(1)?, Process::echo()?);
    let mut served = Client::open(&server.socket, "CartPole", BATCH).await?;
    let mut bare = Client::open(&echo.socket, "CartPole", BATCH).await?;
    let (mut ratios, mut steps) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let echoed = TRIPS as f64 / bare.run(TRIPS).await?;
        let stepped = TRIPS as f64 / served.run(TRIPS).await?;
        ratios.push(stepped / echoed);
        steps.push(stepped * BATCH as f64);
    }
    println!("step/CartPole/256      {:>12.0} env steps/s over a Unix socket", median(&mut steps));
    println!("step/CartPole/256      {:>12.2} of a bare echo's round trips x 256 (at least 0.5)", median(&mut ratios));
    Ok(())
}

/// (b) A MuJoCo model in batches of 64 on two workers against twice the bare loop.
async fn locomotion(name: &'static str) -> Result<(), Failure> {
    const BATCH: usize = 64;
    const TRIPS: usize = 60;
    let server = Process::server(2)?;
    let mut served = Client::open(&server.socket, name, BATCH).await?;
    let (mut bare, mut ceilings) = (Vec::new(), Vec::new());
    let mut loops = [("closed loop", 1), ("two requests in flight", 2)]
        .map(|(kind, in_flight)| (kind, in_flight, Figures::default()));
    for _ in 0..ROUNDS {
        let one = bare_loop(name, TRIPS * BATCH / 4).await?;
        let (a, b) = tokio::try_join!(bare_loop(name, TRIPS * BATCH / 4), bare_loop(name, TRIPS * BATCH / 4))?;
        for (_, in_flight, figures) in &mut loops {
            let rate = (TRIPS * BATCH) as f64 / served.run_ahead(TRIPS, *in_flight).await?;
            figures.rates.push(rate);
            figures.of_twice.push(rate / (2.0 * one));
            figures.of_both.push(rate / (a + b));
        }
        ceilings.push((a + b) / (2.0 * one));
        bare.push(one);
    }
    let id = format!("step/{name}/64");
    for (kind, _, mut figures) in loops {
        println!("{id:<22} {:>12.0} env steps/s, two workers, {kind}", median(&mut figures.rates));
        println!("{id:<22} {:>12.2} of twice the bare loop, {kind} (at least 0.8)", median(&mut figures.of_twice));
        println!("{id:<22} {:>12.2} of two bare loops at once, {kind}", median(&mut figures.of_both));
    }
    println!(
        "{id:<22} {:>12.0} steps/s of the bare loop; two at once reach {:.2} of twice one",
        median(&mut bare),
        median(&mut ceilings)
    );
    Ok(())
}

/// One kind of served loop, round by round.
#[derive(Default)]
struct Figures {
    /// Environment steps/s.
    rates: Vec<f64>,
    of_twice: Vec<f64>,
    of_both: Vec<f64>,
}

/// (c) One environment.
async fn round_trip() -> Result<(), Failure> {
    const TRIPS: usize = 20_000;
    let server = Process::server(1)?;
    let mut client = Client::open(&server.socket, "CartPole", 1).await?;
    client.run(TRIPS / 10).await?;
    let mut micros = Vec::with_capacity(TRIPS);
    for _ in 0..TRIPS {
        micros.push(client.run(1).await? * 1e6);
    }
    micros.sort_by(f64::total_cmp);
    let at = |q: f64| micros[(q * (TRIPS - 1) as f64) as usize];
    println!("round_trip/CartPole/1  {:>12.1} us p50, {:.1} us p99", at(0.5), at(0.99));
    Ok(())
}

/// (d) Resident memory of a Hopper, stepped so that its pages are in use.
async fn memory() -> Result<(), Failure> {
    const BATCH: usize = 2000;
    if tasks::catalogue().find("Hopper").is_err() {
        return Ok(());
    }
    let server = Process::server(2)?;
    Client::open(&server.socket, "Hopper", 1).await?.run(10).await?;
    let before = server.resident()?;
    let mut client = Client::open(&server.socket, "Hopper", BATCH).await?;
    client.run(50).await?;
    let each = (server.resident()? - before) / BATCH as f64;
    println!("memory/Hopper           {:>12.1} kB for each environment (at most 150)", each / 1e3);
    Ok(())
}

/// (e) Pictures of one environment, each asked for after the last came.
async fn pictures(name: &'static str) -> Result<(), Failure> {
    const PICTURES: usize = 10;
    let server = Process::server(1)?;
    let mut client = Client::open(&server.socket, name, 1).await?;
    client.run(10).await?;
    let before = server.resident()?;
    client.draw().await?; // the first one loads the driver
    let mut rates = Vec::new();
    for _ in 0..ROUNDS {
        let start = Instant::now();
        for _ in 0..PICTURES {
            client.draw().await?;
        }
        rates.push(PICTURES as f64 / start.elapsed().as_secs_f64());
    }
    let id = format!("render/{name}/480");
    let grown = (server.resident()? - before) / 1e6;
    println!("{id:<22} {:>12.0} pictures/s over a Unix socket; {grown:.0} MB more memory", median(&mut rates));
    Ok(())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Steps/s of one environment on a thread of its own, with actions as the client sends them.
async fn bare_loop(name: &'static str, steps: usize) -> Result<f64, Failure> {
    let rate = tokio::task::spawn_blocking(move || bare_loop_here(name, steps).map_err(|error| error.to_string()));
    Ok(rate.await??)
}

fn bare_loop_here(name: &str, steps: usize) -> Result<f64, Failure> {
    let spec = tasks::catalogue().find(name)?;
    let distributions = spec.distributions(Version::D);
    let settings = Settings { seed: 1, environment_index: 0, distributions, episodes_per_trial: 1 };
    let mut episodes = Episodes::new(tasks::catalogue().find(name).and_then(|spec| (spec.make)())?, settings);
    let (mut terms, mut observation) = (vec![0.0; spec.reward_terms.len()], vec![0.0; spec.observation.len()]);
    let mut noise = Noise(1);
    let mut action = vec![0.0; width(spec)];
    let start = Instant::now();
    for _ in 0..steps {
        action.iter_mut().for_each(|a| *a = noise.unit());
        episodes.step(Action::Continuous(&action), &mut terms);
        episodes.observe(&mut observation);
        if episodes.ended() {
            episodes.begin(None);
        }
    }
    let rate = steps as f64 / start.elapsed().as_secs_f64();
    assert!(observation.iter().all(|x| x.is_finite()));
    Ok(rate)
}

fn width(spec: &EnvironmentSpec) -> usize {
    match spec.action {
        ActionSpace::Discrete(_) => 1,
        ActionSpace::Continuous(channels) => channels.len(),
    }
}

/// A small generator for actions: their quality does not matter here, their cost does.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        self.0 >> 33
    }

    fn unit(&mut self) -> f32 {
        self.next() as f32 / (1u64 << 30) as f32 - 1.0
    }
}

/// A session that steps with random actions.
struct Client {
    spec: &'static EnvironmentSpec,
    batch: usize,
    session: Session,
    noise: Noise,
}

impl Client {
    async fn open(socket: &Path, name: &str, batch: usize) -> Result<Self, Failure> {
        let connection = Connection::open(&Address::Unix(socket.into())).await?;
        let open = proto::Open {
            environment: name.into(),
            version: proto::Version::Default.into(),
            batch_size: batch as u32,
            seed: 1,
            autoreset_mode: proto::AutoresetMode::SameStep.into(),
            ..Default::default()
        };
        let (session, _) = Session::open(&connection, open).await?;
        Ok(Self { spec: tasks::catalogue().find(name)?, batch, session, noise: Noise(7) })
    }

    /// Takes `trips` steps, each after the reply to the last. Returns the seconds.
    async fn run(&mut self, trips: usize) -> Result<f64, Failure> {
        self.run_ahead(trips, 1).await
    }

    /// Takes `trips` steps with up to `in_flight` requests on their way. Returns the seconds until the last reply.
    async fn run_ahead(&mut self, trips: usize, in_flight: usize) -> Result<f64, Failure> {
        let start = Instant::now();
        for _ in 1..in_flight.min(trips) {
            self.send().await?;
        }
        for trip in 0..trips {
            if trip + in_flight <= trips {
                self.send().await?;
            }
            self.receive().await?;
        }
        Ok(start.elapsed().as_secs_f64())
    }

    /// Asks for a picture and waits for it.
    async fn draw(&mut self) -> Result<(), Failure> {
        let picture = self.session.ask(proto::Render::default()).await?;
        assert_eq!((picture.width, picture.height, picture.pixels.len()), (480, 480, 480 * 480 * 3));
        Ok(())
    }

    async fn send(&mut self) -> Result<(), Failure> {
        let actions = self.actions();
        Ok(self.session.send(proto::Step { actions }).await?)
    }

    async fn receive(&mut self) -> Result<(), Failure> {
        let stepped = self.session.receive::<proto::Step>().await?;
        assert_eq!(stepped.observations.len(), 4 * self.batch * self.spec.observation.len());
        assert_eq!(stepped.rewards.len(), 4 * self.batch);
        Ok(())
    }

    fn actions(&mut self) -> Bytes {
        let mut bytes = Vec::with_capacity(4 * self.batch * width(self.spec));
        for _ in 0..self.batch * width(self.spec) {
            match self.spec.action {
                ActionSpace::Discrete(names) => {
                    bytes.extend(((self.noise.next() % names.len() as u64) as i32).to_le_bytes());
                }
                ActionSpace::Continuous(_) => bytes.extend(self.noise.unit().to_le_bytes()),
            }
        }
        bytes.into()
    }
}

/// A server process with a socket of its own.
struct Process {
    child: Child,
    socket: std::path::PathBuf,
    _directory: tempfile::TempDir,
}

impl Process {
    fn server(workers: usize) -> Result<Self, Failure> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb-server"));
        command.args(["--log", "warn", "--workers", &workers.to_string()]);
        Self::start(command, |socket| vec!["--listen".into(), format!("unix:{}", socket.display())])
    }

    fn echo() -> Result<Self, Failure> {
        Self::start(Command::new(process_env::current_exe()?), |socket| {
            vec!["echo".into(), socket.display().to_string()]
        })
    }

    fn start(mut command: Command, arguments: impl Fn(&Path) -> Vec<String>) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        let socket = directory.path().join("socket");
        let mut child = command.args(arguments(&socket)).stdout(Stdio::piped()).spawn()?;
        let stdout = child.stdout.take().ok_or("no standard output")?;
        BufReader::new(stdout).read_line(&mut String::new())?;
        Ok(Self { child, socket, _directory: directory })
    }

    /// Resident bytes.
    fn resident(&self) -> Result<f64, Failure> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line = status.lines().find(|line| line.starts_with("VmRSS:")).ok_or("no VmRSS")?;
        Ok(line.split_whitespace().nth(1).ok_or("no VmRSS")?.parse::<f64>()? * 1024.0)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Answers every step with a reply of the same size as the server's, made in advance.
struct Echo;

#[tonic::async_trait]
impl Perturb for Echo {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<SessionResponse, Status>> + Send>>;

    async fn list_environments(
        &self,
        _: Request<proto::ListEnvironmentsRequest>,
    ) -> Result<Response<proto::ListEnvironmentsResponse>, Status> {
        Err(Status::unimplemented("this is an echo"))
    }

    async fn session(
        &self,
        requests: Request<Streaming<SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let reply = proto::Stepped {
            observations: Bytes::from(vec![0; 256 * 16]),
            rewards: Bytes::from(vec![0; 256 * 4]),
            terminated: Bytes::from(vec![0; 256]),
            truncated: Bytes::from(vec![0; 256]),
            ..Default::default()
        };
        let responses = requests.into_inner().map(move |request| {
            let response = match request?.request {
                Some(Ask::Open(_)) => Answer::Opened(proto::Opened::default()),
                _ => Answer::Stepped(reply.clone()),
            };
            Ok(SessionResponse { response: Some(response) })
        });
        Ok(Response::new(Box::pin(responses)))
    }
}

async fn echo(socket: &Path) -> Result<(), Failure> {
    let listener = UnixListener::bind(socket)?;
    println!("listening");
    Ok(Server::builder()
        .add_service(PerturbServer::new(Echo))
        .serve_with_incoming(UnixListenerStream::new(listener))
        .await?)
}
