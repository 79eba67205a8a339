//! A real `perturb-server` in a process of its own, and a client for its sessions.

use bytes::Bytes;
use perturb::proto::{
    self, AutoresetMode, Environment, Open, Render, Restore, SessionRequest, SessionResponse, Snapshot, Step, Stepped,
    Version, action_space::Kind, perturb_client::PerturbClient, session_request::Request, session_response::Response,
};
use perturb_protocol::TypedRequest;
use std::{
    future::Future,
    io::{BufRead, BufReader},
    path::PathBuf,
    process::{Child, ChildStdin, Command, ExitStatus, Stdio},
    sync::mpsc,
    time::{Duration, Instant},
};
use tempfile::TempDir;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{
    Code, Status, Streaming,
    transport::{Channel, Endpoint},
};

/// A timeout far longer than anything in the tests takes, so that only a hang exceeds it.
pub const DEADLINE: Duration = Duration::from_secs(120);
/// The number of steps that [`Session::play`] sends before it reads a reply.
const AHEAD: u64 = 32;

/// A running server. The server is killed when this value is dropped.
pub struct Server {
    pub child: Child,
    /// The addresses at which it listens, in the order in which it printed them.
    pub addresses: Vec<String>,
    pub directory: TempDir,
    /// The server's standard input, which closes when this value is dropped.
    pub stdin: Option<ChildStdin>,
}

impl Server {
    /// Starts a server with these flags, on a free TCP port and a Unix socket.
    pub fn start(flags: &[&str]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let socket = format!("unix:{}", directory.path().join("socket").display());
        let mut command = command();
        command.args(["--listen", "tcp://127.0.0.1:0", "--listen", &socket]).args(flags);
        Self::spawn(command, directory, 2)
    }

    /// Like [`Server::start`], with the tasks of examples/tasks if there is MuJoCo.
    pub fn with_folders(flags: &[&str]) -> Self {
        #[cfg(feature = "mujoco")]
        {
            let folders = super::folders();
            let tasks = folders.iter().flat_map(|folder| ["--task", folder.to_str().unwrap()]);
            Self::start(&flags.iter().copied().chain(tasks).collect::<Vec<_>>())
        }
        #[cfg(not(feature = "mujoco"))]
        Self::start(flags)
    }

    /// Runs a command that starts a server. Waits until it has printed `addresses` addresses.
    pub fn spawn(mut command: Command, directory: TempDir, addresses: usize) -> Self {
        let log = std::fs::File::create(directory.path().join("log")).unwrap();
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let lines = lines(child.stdout.take().unwrap());
        let stdin = child.stdin.take();
        let mut server = Self { child, addresses: Vec::new(), directory, stdin };
        for _ in 0..addresses {
            let line = lines.recv_timeout(DEADLINE).expect("the server ended before it listened");
            server.addresses.push(line.strip_prefix("listening on ").expect(&line).to_owned());
        }
        server
    }

    /// The address of the TCP port.
    pub fn tcp(&self) -> &str {
        self.addresses.iter().find(|a| a.starts_with("http://")).unwrap()
    }

    /// The TCP port as "host:port".
    pub fn port(&self) -> &str {
        self.tcp().strip_prefix("http://").unwrap()
    }

    /// The address of the Unix socket.
    pub fn unix(&self) -> &str {
        self.addresses.iter().find(|a| a.starts_with("unix:")).unwrap()
    }

    /// The path of the Unix socket.
    pub fn socket(&self) -> PathBuf {
        self.unix().strip_prefix("unix:").unwrap().into()
    }

    /// Returns the log so far.
    pub fn log(&self) -> String {
        String::from_utf8_lossy(&std::fs::read(self.directory.path().join("log")).unwrap()).into_owned()
    }

    /// Sends the server a signal.
    pub fn signal(&self, signal: &str) {
        self::signal(self.child.id(), signal);
    }

    /// Waits until the server's process ends.
    pub async fn ended(&mut self) -> ExitStatus {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status;
            }
            assert!(start.elapsed() < DEADLINE, "the server does not end; it logged:\n{}", self.log());
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    /// Returns the server's start time, s since 1970, from the creation time of its log file.
    pub fn started_seconds(&self) -> f64 {
        let log = std::fs::metadata(self.directory.path().join("log")).unwrap();
        let created = log.created().or_else(|_| log.modified()).unwrap();
        created.duration_since(std::time::UNIX_EPOCH).unwrap().as_secs_f64()
    }

    /// Returns the server's resident memory, bytes.
    pub fn memory(&self) -> usize {
        self.memory_line("VmRSS:")
    }

    /// Returns the server's peak resident memory, bytes.
    pub fn peak_memory(&self) -> usize {
        self.memory_line("VmHWM:")
    }

    fn memory_line(&self, name: &str) -> usize {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with(name)).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<usize>().unwrap() * 1024
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("the server logged:\n{}", self.log());
        }
    }
}

/// The environment variable with the default number of transport threads of servers in tests. `make threads-test` sets
/// it.
const TRANSPORT_THREADS: &str = "PERTURB_TEST_TRANSPORT_THREADS";

/// Returns the command of the server program.
pub fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_perturb-server"));
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_string_lossy().starts_with("PERTURB_SERVER_")) {
        command.env_remove(name);
    }
    if let Some(threads) = std::env::var_os(TRANSPORT_THREADS) {
        command.env("PERTURB_SERVER_TRANSPORT_THREADS", threads);
    }
    command
}

/// Sends a signal to a process that the test started.
pub fn signal(process: u32, signal: &str) {
    let sent = Command::new("kill").args([format!("-{signal}"), process.to_string()]).status().unwrap();
    assert!(sent.success(), "kill -{signal} {process}: {sent}");
}

/// Returns a receiver of the lines that a process prints.
pub fn lines(output: impl std::io::Read + Send + 'static) -> mpsc::Receiver<String> {
    let (sender, lines) = mpsc::channel();
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    lines
}

/// Returns the future's output. Panics if the future hangs.
pub async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(DEADLINE, future).await.expect("no answer before the deadline")
}

/// Repeats `ask` until it returns true. Panics, naming `what`, if that takes too long.
pub async fn until(what: &str, mut ask: impl AsyncFnMut() -> bool) {
    let start = Instant::now();
    while !within(ask()).await {
        assert!(start.elapsed() < DEADLINE, "still waiting until {what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Opens a new connection.
pub async fn channel(address: &str) -> Channel {
    let endpoint = Endpoint::from_shared(address.to_owned()).unwrap().tcp_nodelay(true);
    within(endpoint.connect()).await.unwrap_or_else(|error| panic!("no connection to {address}: {error:?}"))
}

/// Returns a client on a new connection.
pub async fn client(address: &str) -> PerturbClient<Channel> {
    PerturbClient::new(channel(address).await).max_decoding_message_size(usize::MAX)
}

/// Returns the catalogue of the server.
pub async fn catalogue(address: &str) -> Vec<Environment> {
    let reply = within(client(address).await.list_environments(proto::ListEnvironmentsRequest {})).await.unwrap();
    reply.into_inner().environments
}

/// Returns one entry of the server's catalogue.
pub async fn environment(address: &str, name: &str) -> Environment {
    catalogue(address).await.into_iter().find(|e| e.name == name).unwrap()
}

/// A client's session.
pub struct Session {
    requests: Option<tokio::sync::mpsc::Sender<SessionRequest>>,
    responses: Streaming<SessionResponse>,
}

impl Session {
    /// Starts a session on a new connection, without opening it.
    pub async fn connect(address: &str) -> Self {
        Self::start(&mut client(address).await).await.unwrap()
    }

    /// Starts a session on an existing connection, without opening it.
    pub async fn start(client: &mut PerturbClient<Channel>) -> Result<Self, Status> {
        Self::show(client, None).await
    }

    /// Like [`Session::start`], with a token.
    pub async fn show(client: &mut PerturbClient<Channel>, token: Option<&str>) -> Result<Self, Status> {
        let (requests, receiver) = tokio::sync::mpsc::channel(1024);
        let mut call = tonic::Request::new(ReceiverStream::new(receiver));
        if let Some(token) = token {
            call.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
        }
        let responses = within(client.session(call)).await?.into_inner();
        Ok(Self { requests: Some(requests), responses })
    }

    /// Opens a session on a new connection.
    pub async fn open(address: &str, open: Open) -> (Self, proto::Opened) {
        let mut session = Self::connect(address).await;
        let opened = session.ask(open).await;
        (session, opened)
    }

    /// Sends a request without waiting for its response. If the session has ended, [`Session::receive`] returns the
    /// reason.
    pub async fn send(&self, request: impl Into<Request>) {
        let requests = self.requests.as_ref().expect("closed already");
        let _ = within(requests.send(SessionRequest { request: Some(request.into()) })).await;
    }

    /// Returns a sender of requests, for use by other tasks.
    pub fn sender(&self) -> tokio::sync::mpsc::Sender<SessionRequest> {
        self.requests.clone().unwrap()
    }

    /// Closes the sending half of the stream.
    pub fn close(&mut self) {
        self.requests = None;
    }

    /// Returns the next response, or `None` at the end of the stream.
    pub async fn receive(&mut self) -> Result<Option<SessionResponse>, Status> {
        within(self.responses.message()).await
    }

    /// Reads all remaining responses. Returns the status with which the stream ends.
    pub async fn end(&mut self) -> Status {
        loop {
            match self.receive().await {
                Ok(Some(_)) => {}
                Ok(None) => return Status::ok(""),
                Err(status) => return status,
            }
        }
    }

    /// Sends a request and returns its response, which may be an error.
    pub async fn answer(&mut self, request: impl Into<Request>) -> Response {
        self.send(request).await;
        let response = self.receive().await.unwrap().expect("the stream ended");
        response.response.expect("a response is never empty")
    }

    /// Sends a request and returns its reply. Panics if it is refused.
    pub async fn ask<A: TypedRequest>(&mut self, request: A) -> A::Reply {
        let response = self.answer(request).await;
        A::reply(response).unwrap_or_else(|other| panic!("{} was answered by {other:?}", A::NAME))
    }

    /// Sends a request that must be refused. Returns the code and the message.
    pub async fn refused(&mut self, request: impl Into<Request>) -> (Code, String) {
        match self.answer(request).await {
            Response::Error(error) => (Code::from_i32(error.code), error.message),
            other => panic!("was not refused but answered by {other:?}"),
        }
    }

    /// Takes a step with these actions.
    pub async fn step(&mut self, actions: Bytes) -> Stepped {
        self.ask(Step { actions }).await
    }

    /// Takes snapshots of the environments that the mask selects.
    pub async fn snapshot(&mut self, mask: &[u8]) -> Vec<Bytes> {
        self.ask(Snapshot { mask: Bytes::copy_from_slice(mask) }).await.snapshots
    }

    /// Restores the environments that the mask selects. Returns their observations.
    pub async fn restore(&mut self, mask: &[u8], snapshots: Vec<Bytes>) -> Bytes {
        self.ask(Restore { mask: Bytes::copy_from_slice(mask), snapshots }).await.observations
    }

    /// Requests a picture. Returns its pixels, `[height, width, 3]`.
    pub async fn render(&mut self, slot: u32, (width, height): (u32, u32)) -> Bytes {
        self.ask(Render { slot, width, height }).await.pixels
    }

    /// Takes pipelined steps with the random actions of times `from` … `to`-1. Returns the responses.
    pub async fn play(&mut self, actor: Actor<'_>, from: u64, to: u64) -> Vec<SessionResponse> {
        let mut responses = Vec::new();
        let mut sent = from;
        for t in from..to {
            while sent < to && sent < t + AHEAD {
                self.send(step(actor.actions(sent))).await;
                sent += 1;
            }
            responses.push(self.receive().await.unwrap().expect("the stream ended"));
        }
        responses
    }
}

/// Random actions for a batch of `n` environments, of which the first has index `first`. An environment's action is a
/// function of its index and the time only. Continuous actions sometimes exceed their ranges, which is allowed.
#[derive(Clone, Copy)]
pub struct Actor<'a> {
    pub environment: &'a Environment,
    pub first: u64,
    pub n: usize,
}

impl<'a> Actor<'a> {
    /// Makes the actor of a batch whose first environment index is 0.
    pub fn new(environment: &'a Environment, n: usize) -> Self {
        Self { environment, first: 0, n }
    }

    /// Returns the batch's encoded actions at time `t`.
    pub fn actions(self, t: u64) -> Bytes {
        (self.first..).take(self.n).flat_map(|index| action(self.environment, index, t)).collect()
    }
}

/// Returns the encoded action of one environment.
pub fn action(environment: &Environment, index: u64, t: u64) -> Vec<u8> {
    let unit = |entry: u64| mixed(mixed(mixed(index) ^ t) ^ entry) as f64 / u64::MAX as f64 * (1.0 - 1e-9);
    match environment.action.as_ref().unwrap().kind.as_ref().unwrap() {
        Kind::Discrete(space) => ((unit(0) * space.names.len() as f64) as i32).to_le_bytes().to_vec(),
        Kind::Continuous(space) => {
            let entry = |(i, c): (u64, &proto::Channel)| (1.2 * (c.low + (c.high - c.low) * unit(i))) as f32;
            (0..).zip(&space.channels).flat_map(|channel| entry(channel).to_le_bytes()).collect()
        }
    }
}

/// The finaliser of SplitMix64, a hash function.
pub fn mixed(x: u64) -> u64 {
    let x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Returns an `open` with all features: version R, receipts and reward terms, next-step autoreset.
pub fn open(environment: &str, batch_size: u32, seed: u64) -> Open {
    Open {
        environment: environment.into(),
        version: Version::Random.into(),
        batch_size,
        seed,
        autoreset_mode: AutoresetMode::NextStep.into(),
        receipts: true,
        reward_terms: true,
        ..Open::default()
    }
}

/// Returns a request for a step with these actions.
pub fn step(actions: impl Into<Bytes>) -> Request {
    Request::Step(Step { actions: actions.into() })
}

/// Formats a refusal as a line of a snapshot file.
pub fn refusal((code, message): (Code, String)) -> String {
    // A server without MuJoCo has two fewer environments.
    format!("{code:?}: {}\n", message.replace(", HalfCheetah, Hopper", ""))
}

/// Returns the result of a step in a response. Panics if the response is of another kind.
pub fn stepped(response: &SessionResponse) -> &Stepped {
    match &response.response {
        Some(Response::Stepped(stepped)) => stepped,
        other => panic!("step was answered by {other:?}"),
    }
}

/// Decodes little-endian f32 values.
pub fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|word| f32::from_le_bytes(*word)).collect()
}

/// Encodes f64 values as little-endian bytes.
pub fn doubles(numbers: &[f64]) -> Bytes {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

/// Returns a distribution over these intervals.
pub fn union(intervals: &[(f64, f64)]) -> proto::Distribution {
    proto::Distribution { intervals: intervals.iter().map(|&(low, high)| proto::Interval { low, high }).collect() }
}

/// Returns distributions by the names of their parameters.
pub fn parameters(each: &[(&str, &[(f64, f64)])]) -> std::collections::HashMap<String, proto::Distribution> {
    each.iter().map(|(name, intervals)| ((*name).into(), union(intervals))).collect()
}

/// Returns contexts: the values of these parameters, row by row.
pub fn contexts(names: &[&str], values: &[f64]) -> proto::Contexts {
    proto::Contexts { names: names.iter().map(|&name| name.into()).collect(), values: values.into() }
}
