//! A server process, and a client that steps its environments with random actions.

use super::Failure;
use bytes::Bytes;
use perturb::{
    env::{ActionSpec, Distribution, EnvironmentSpec},
    proto, tasks,
};
use perturb_protocol::{Address, Connection, Stream as Session};
use std::{
    env, fs,
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::Instant,
};

/// The seed of every session.
pub(crate) const SEED: u64 = 1;

/// A session on a server, which is stepped with random actions.
pub(crate) struct Client {
    spec: &'static EnvironmentSpec,
    batch: usize,
    session: Session,
    noise: Noise,
}

impl Client {
    pub(crate) async fn open(socket: &Path, name: &str, batch: usize) -> Result<Self, Failure> {
        Self::on(&Connection::open(&Address::Unix(socket.into())).await?, name, batch).await
    }

    pub(crate) async fn on(connection: &Connection, name: &str, batch: usize) -> Result<Self, Failure> {
        Self::with_spec(connection, tasks::catalogue().find(name)?, batch, &[]).await
    }

    /// Opens an environment, given by its name, with fixed values of disturbances.
    pub(crate) async fn open_disturbed(
        socket: &Path,
        name: &str,
        batch: usize,
        values: &[(&str, f64)],
    ) -> Result<Self, Failure> {
        let connection = Connection::open(&Address::Unix(socket.into())).await?;
        let fixed: Vec<_> = values.iter().map(|&(name, value)| (name, Distribution::fixed(value))).collect();
        Self::with_spec(&connection, tasks::catalogue().find(name)?, batch, &fixed).await
    }

    /// Opens any environment, given by its specification.
    #[cfg(feature = "mujoco")]
    pub(crate) async fn open_spec(
        socket: &Path,
        spec: &'static EnvironmentSpec,
        batch: usize,
    ) -> Result<Self, Failure> {
        Self::open_drawn(socket, spec, batch, &[]).await
    }

    /// Opens any environment, given by its specification. Its parameters are drawn from these distributions.
    #[cfg(feature = "mujoco")]
    pub(crate) async fn open_drawn(
        socket: &Path,
        spec: &'static EnvironmentSpec,
        batch: usize,
        drawn: &[(&str, Distribution)],
    ) -> Result<Self, Failure> {
        Self::with_spec(&Connection::open(&Address::Unix(socket.into())).await?, spec, batch, drawn).await
    }

    async fn with_spec(
        connection: &Connection,
        spec: &'static EnvironmentSpec,
        batch: usize,
        drawn: &[(&str, Distribution)],
    ) -> Result<Self, Failure> {
        let named = |(name, distribution): &(&str, Distribution)| ((*name).to_owned(), distribution.into());
        let open = proto::Open {
            environment: spec.name.into(),
            version: proto::Version::Default.into(),
            batch_size: batch as u32,
            seed: SEED,
            autoreset_mode: proto::AutoresetMode::SameStep.into(),
            parameters: drawn.iter().map(named).collect(),
            ..Default::default()
        };
        let (session, _) = Session::open(connection, open).await?;
        Ok(Self { spec, batch, session, noise: Noise(7) })
    }

    /// Makes `trips` steps. Each step is requested after the reply to the previous step. Returns the elapsed time in
    /// seconds.
    pub(crate) async fn run(&mut self, trips: usize) -> Result<f64, Failure> {
        let actions: Vec<Bytes> = (0..trips).map(|_| self.actions()).collect();
        let start = Instant::now();
        self.play(&actions, 1).await?;
        Ok(start.elapsed().as_secs_f64())
    }

    /// Makes a step with each element of `actions`. Up to `in_flight` requests may wait for their replies at the same
    /// time. Returns the observations after the last step.
    pub(crate) async fn play(&mut self, actions: &[Bytes], in_flight: usize) -> Result<Bytes, Failure> {
        let mut sent = 0;
        let mut last = Bytes::new();
        for received in 0..actions.len() {
            while sent < actions.len().min(received + in_flight) {
                self.session.send(proto::Step { actions: actions[sent].clone() }).await?;
                sent += 1;
            }
            let stepped = self.session.receive::<proto::Step>().await?;
            assert_eq!(stepped.observations.len(), 4 * self.batch * self.spec.observation.len());
            assert_eq!(stepped.rewards.len(), 4 * self.batch);
            last = stepped.observations;
        }
        Ok(last)
    }

    /// Makes the server play `steps` steps with a policy. Returns the elapsed time in seconds.
    pub(crate) async fn act(&mut self, request: proto::Act, steps: u32) -> Result<f64, Failure> {
        let start = Instant::now();
        let acted = self.session.ask(request).await?;
        assert_eq!((acted.steps, acted.values.len()), (steps, 4 * self.batch * steps as usize));
        Ok(start.elapsed().as_secs_f64())
    }

    /// Requests a rendered picture and waits for it.
    pub(crate) async fn draw(&mut self) -> Result<(), Failure> {
        let picture = self.session.ask(proto::Render::default()).await?;
        assert_eq!((picture.width, picture.height, picture.pixels.len()), (480, 480, 480 * 480 * 3));
        Ok(())
    }

    /// Returns random actions of all environments for the next step, in the protocol's encoding.
    pub(crate) fn actions(&mut self) -> Bytes {
        let mut bytes = Vec::with_capacity(4 * self.batch * width(self.spec));
        for _ in 0..self.batch * width(self.spec) {
            match self.spec.action {
                ActionSpec::Discrete(names) => {
                    bytes.extend(((self.noise.next() % names.len() as u64) as i32).to_le_bytes());
                }
                ActionSpec::Continuous(_) => bytes.extend(self.noise.unit().to_le_bytes()),
            }
        }
        bytes.into()
    }
}

/// Returns the number of elements of an action.
pub(crate) fn width(spec: &EnvironmentSpec) -> usize {
    match spec.action {
        ActionSpec::Discrete(_) => 1,
        ActionSpec::Continuous(channels) => channels.len(),
    }
}

/// A simple random number generator for actions. Its quality does not matter here.
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

/// A server process with its own socket.
pub(crate) struct ServerProcess {
    child: Child,
    pub(crate) socket: PathBuf,
    /// The address that the server has printed.
    pub(crate) address: String,
    _directory: tempfile::TempDir,
}

impl ServerProcess {
    pub(crate) fn server(workers: usize) -> Result<Self, Failure> {
        Self::with_flags(workers, &[])
    }

    /// Starts a server with additional flags.
    pub(crate) fn with_flags(workers: usize, flags: &[&Path]) -> Result<Self, Failure> {
        Self::program(env!("CARGO_BIN_EXE_perturb-server").as_ref(), workers, flags)
    }

    /// Starts another executable of the server.
    pub(crate) fn program(program: &Path, workers: usize, flags: &[&Path]) -> Result<Self, Failure> {
        let mut command = Command::new(program);
        command.args(["--log", "warn", "--workers", &workers.to_string()]).args(flags);
        Self::start(command, |socket| vec!["--listen".into(), format!("unix:{}", socket.display())])
    }

    /// Starts a server that listens on a TCP port instead of a Unix socket.
    pub(crate) fn tcp(workers: usize, flags: &[(&str, &Path)]) -> Result<Self, Failure> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_perturb-server"));
        command.args(["--log", "warn", "--workers", &workers.to_string()]);
        for (flag, value) in flags {
            command.arg(flag).arg(value);
        }
        Self::start(command, |_| vec!["--listen".into(), "tcp://127.0.0.1:0".into()])
    }

    pub(crate) fn echo() -> Result<Self, Failure> {
        Self::start(Command::new(env::current_exe()?), |socket| vec!["echo".into(), socket.display().to_string()])
    }

    fn start(mut command: Command, arguments: impl Fn(&Path) -> Vec<String>) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        let socket = directory.path().join("socket");
        let mut child = command.args(arguments(&socket)).stdout(Stdio::piped()).spawn()?;
        let stdout = child.stdout.take().ok_or("no standard output")?;
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line)?;
        let address = line.trim().trim_start_matches("listening on ").to_owned();
        Ok(Self { child, socket, address, _directory: directory })
    }

    /// Returns the path of the process's folder in /proc.
    pub(crate) fn proc(&self) -> PathBuf {
        format!("/proc/{}", self.child.id()).into()
    }

    /// Returns the resident memory of the process, in bytes.
    pub(crate) fn resident(&self) -> Result<f64, Failure> {
        let status = fs::read_to_string(self.proc().join("status"))?;
        let line = status.lines().find(|line| line.starts_with("VmRSS:")).ok_or("no VmRSS")?;
        Ok(line.split_whitespace().nth(1).ok_or("no VmRSS")?.parse::<f64>()? * 1024.0)
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
