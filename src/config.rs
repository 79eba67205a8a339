//! The server's configuration: defaults, then a TOML file, then environment variables, then flags.

use clap::Parser;
use config::{Environment, File, FileFormat};
use perturb_protocol::limits::{DEFAULT_MAX_ENVS, DEFAULT_MAX_MESSAGE_BYTES, DEFAULT_PORT};
use serde::{Deserialize, Serialize};
use std::{
    fmt,
    net::SocketAddr,
    path::{Path, PathBuf},
    time::Duration,
};
use tracing_subscriber::filter::{LevelFilter, Targets};

const ENV_PREFIX: &str = "PERTURB_SERVER";
/// A day. The transport adds the interval to the present, which must not overflow.
const MOST_SECONDS: u64 = 86_400;
/// Less than one session's pictures need.
const LEAST_MEMORY: usize = 1 << 20;
/// The settings of `--private`. The limits guard shared servers; the memory is the program's own affair. Between two
/// steps it may compute for long: its death closes the socket and the pipe anyway.
const PRIVATE: &str = "
    exit_with_stdin = true
    grace_seconds = 1
    keepalive_seconds = 3600
    max_envs = 16777216
    max_sessions = 65536
    max_message_bytes = 1073741824
    max_memory = 1099511627776
    handshake_seconds = 3600
    stall_seconds = 0
";

/// Serves reinforcement-learning environments whose physics can be changed, over gRPC.
///
/// Every flag may also stand in the TOML file given by --config (`max_envs = 64`) or in an environment variable
/// (`PERTURB_SERVER_MAX_ENVS=64`). A flag beats a variable, a variable beats the file.
#[derive(Debug, Default, Parser, Serialize)]
#[command(name = "perturb-server", version = crate::VERSION)]
pub struct Arguments {
    /// A TOML file with settings.
    #[arg(long, value_name = "FILE", env = "PERTURB_SERVER_CONFIG")]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Where to listen: unix:/path/to/socket, or tcp://address:port; port 0 takes a free one. Repeatable. The addresses
    /// in use are printed on standard output. [default: tcp://127.0.0.1:7447]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub listen: Vec<String>,
    /// Physics threads. [default: one a core]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub workers: Option<usize>,
    /// The most environments, over all sessions. [default: 16384]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_envs: Option<usize>,
    /// The most sessions at a time. [default: 1024]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_sessions: Option<usize>,
    /// The largest request, in bytes. [default: 67108864]
    #[arg(long, value_name = "BYTES")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_message_bytes: Option<usize>,
    /// The most bytes of what is in flight over all sessions: requests, replies, pictures, policies that play. What is
    /// beyond is refused. [default: a quarter of the machine's memory, or of what a container may have]
    #[arg(long, value_name = "BYTES")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_memory: Option<usize>,
    /// The most sessions of one machine, or of one user by a Unix socket; 0 = as many as there may be. [default: 0]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_peer_sessions: Option<usize>,
    /// How long a connection may take to begin, and a session to be opened. [default: 10]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub handshake_seconds: Option<u64>,
    /// How long a client may leave a request unfinished or a large reply unread before it is ended; 0 = for ever.
    /// [default: 300]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stall_seconds: Option<u64>,
    /// How long running sessions may go on after SIGTERM. [default: 30]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grace_seconds: Option<u64>,
    /// Ends sessions that send nothing for so long; 0 = never. [default: 0]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub idle_seconds: Option<u64>,
    /// How long a session whose client asked for a lease stays when its connection is lost, so that it can be taken up
    /// again; 0 = no leases. [default: 60]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease_seconds: Option<u64>,
    /// How often a silent connection is asked whether it lives; one that does not answer within this time is closed and
    /// its environments are freed. [default: 60]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keepalive_seconds: Option<u64>,
    /// A TOML file of tokens, one of which every call by TCP must show: for each a name, sha256 (or token), and if need
    /// be max_sessions, max_envs, max_steps_per_second, max_bytes and a role, which says what may be drawn from. It is
    /// read again when it changes.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tokens: Option<PathBuf>,
    /// Write into this file what every token draws from (distribution, seed, indices, episodes), before it does, in
    /// lines that are chained to each other; `perturb audit --ledger` reads it. An old one is gone on with.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ledger: Option<PathBuf>,
    /// The server's certificate for TLS on its TCP addresses, in PEM, with those between it and its authority's. The
    /// files of TLS are read again when they change.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_cert: Option<PathBuf>,
    /// The private key of --tls-cert, in PEM.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_key: Option<PathBuf>,
    /// The authorities, as certificates in PEM, one of which must have signed a client's certificate. Without it
    /// clients need none.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_client_ca: Option<PathBuf>,
    /// Where to tell metrics, as Prometheus scrapes them, at the path /metrics: tcp://127.0.0.1:port or unix:/path.
    /// Whoever can connect may read them. [default: nowhere]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics: Option<String>,
    /// Let other machines use this server without asking who they are, or without encryption.
    #[arg(long)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub insecure: bool,
    /// Who may connect to Unix sockets: their files' mode, octal, such as 0660 for the group. [default: 0600]
    #[arg(long, value_name = "MODE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub socket_mode: Option<String>,
    /// What to log on standard error: error, warn, info, debug, trace, or a filter such as perturb=debug.
    /// [default: info]
    #[arg(long, value_name = "FILTER")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log: Option<String>,
    /// Shut down when standard input closes: a program that starts a server through a pipe takes it along, however it
    /// ends itself.
    #[arg(long)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub exit_with_stdin: bool,
    /// Serve the one program that starts this server: --exit-with-stdin, no limits (they guard shared servers), time to
    /// compute for an hour between two requests, a second to end. Only flags count then, neither file nor variables,
    /// which are for servers that people run themselves.
    #[arg(long)]
    #[serde(skip)]
    pub private: bool,
    /// A folder with an MJCF model and a file task.toml, which is served as an environment like the built-in ones; see
    /// docs/tasks.md. Repeatable.
    #[arg(long = "task", value_name = "FOLDER")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tasks: Vec<PathBuf>,
    /// Start no server, but load the folders of --task, each in a process of its own, and print what they are:
    /// observations, actions, rewards, parameters, sizes, speed, and edits without an effect.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub check: bool,
    /// Start no server, but print a JSON schema of task.toml.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub task_schema: bool,
    /// Load this folder under limits of memory and processor time, and print what it is: what a server starts before it
    /// loads a folder itself.
    #[arg(long, value_name = "FOLDER", group = "instead", hide = true)]
    #[serde(skip)]
    pub check_task: Option<PathBuf>,
    /// Say how fast the folder of --check-task is, too.
    #[arg(long, hide = true, requires = "check_task")]
    #[serde(skip)]
    pub measure_task: bool,
    /// Start no server, but ask the one that runs with these settings, at its first address, whether it takes sessions:
    /// exit status 0 if so, else 1. For the health checks of containers.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub health: bool,
    /// Start no server, but print what it would serve, as JSON: the environments with their spaces, parameters and
    /// rules of success, and the limits that clients keep to.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub catalogue: bool,
    /// Start no server, but print a new token on standard output, and on standard error its entry for the file of
    /// --tokens.
    #[arg(long, value_name = "NAME", group = "instead")]
    #[serde(skip)]
    pub new_token: Option<String>,
    /// Start no server, but print what lets a shell complete these flags.
    #[arg(long, value_name = "SHELL", group = "instead")]
    #[serde(skip)]
    pub completions: Option<clap_complete::Shell>,
    /// Start no server, but print the manual page.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub man: bool,
}

/// The configuration in force, validated.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where to listen, at least one.
    pub listen: Vec<ListenAddress>,
    /// Physics threads, 1 … 1024.
    pub workers: usize,
    /// The most environments, over all sessions, 1 … 2^24.
    pub max_envs: usize,
    /// The most sessions at a time, at least 1.
    pub max_sessions: usize,
    /// The largest request in bytes, at least 1024.
    pub max_message_bytes: usize,
    /// The most bytes in flight, at least 1 MiB.
    pub max_memory: usize,
    /// The most sessions of a peer; 0 = as many as there may be.
    pub max_peer_sessions: usize,
    /// How long a connection may take to begin, and a session to be opened, s, 1 … 86400.
    pub handshake_seconds: u64,
    /// How long a client may leave a request unfinished or a large reply unread, s, at most 86400; 0 = for ever.
    pub stall_seconds: u64,
    /// How long running sessions may go on after SIGTERM, s.
    pub grace_seconds: u64,
    /// Ends sessions that send nothing for so long, s; 0 = never.
    pub idle_seconds: u64,
    /// How long a session with a lease stays without a connection, s, at most 86400; 0 = no leases.
    pub lease_seconds: u64,
    /// How often a silent connection is asked whether it lives, s, 1 … 86400.
    pub keepalive_seconds: u64,
    /// The file of tokens that callers must show.
    pub tokens: Option<PathBuf>,
    /// The file of what is drawn.
    pub ledger: Option<PathBuf>,
    /// The server's certificate for TLS.
    pub tls_cert: Option<PathBuf>,
    /// Its private key.
    pub tls_key: Option<PathBuf>,
    /// Whose certificates clients must show.
    pub tls_client_ca: Option<PathBuf>,
    /// Where to tell metrics.
    pub metrics: Option<ListenAddress>,
    /// Whether other machines may use this server unasked or unencrypted.
    pub insecure: bool,
    /// The mode of Unix sockets' files.
    pub socket_mode: SocketMode,
    /// The log filter.
    pub log: String,
    /// Whether to shut down when standard input closes.
    pub exit_with_stdin: bool,
    /// The folders whose tasks are served beside the built-in environments.
    pub tasks: Vec<PathBuf>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: vec![ListenAddress::Tcp(SocketAddr::from(([127, 0, 0, 1], DEFAULT_PORT)))],
            workers: std::thread::available_parallelism().map_or(1, usize::from),
            max_envs: DEFAULT_MAX_ENVS,
            max_sessions: 1024,
            max_message_bytes: DEFAULT_MAX_MESSAGE_BYTES,
            max_memory: usual_memory(),
            max_peer_sessions: 0,
            handshake_seconds: 10,
            stall_seconds: 300,
            grace_seconds: 30,
            idle_seconds: 0,
            lease_seconds: 60,
            keepalive_seconds: 60,
            tokens: None,
            ledger: None,
            tls_cert: None,
            tls_key: None,
            tls_client_ca: None,
            metrics: None,
            insecure: false,
            socket_mode: SocketMode::default(),
            log: "info".into(),
            exit_with_stdin: false,
            tasks: Vec::new(),
        }
    }
}

/// A quarter of the machine's memory, or of what this process's container or service may have.
fn usual_memory() -> usize {
    let rustix::system::Sysinfo { totalram, mem_unit, .. } = rustix::system::sysinfo();
    let machine = (totalram as usize).saturating_mul(mem_unit as usize);
    let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let group = group_memory(Path::new("/sys/fs/cgroup"), &groups);
    (group.unwrap_or(machine).min(machine) / 4).max(LEAST_MEMORY)
}

/// The least that this process's control group, or one around it, may have, in bytes; `groups` is `/proc/self/cgroup`.
fn group_memory(root: &Path, groups: &str) -> Option<usize> {
    let own = groups.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default();
    let around = Path::new(own).ancestors().map(|group| root.join(group).join("memory.max"));
    around.filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse().ok()).min()
}

/// The environment variables that are settings.
fn variables() -> Environment {
    // Other programs' variables need not be UTF-8. A setting that is not is refused with its odd characters replaced.
    let text = std::env::vars_os().map(|(k, v)| (k.to_string_lossy().into_owned(), v.to_string_lossy().into_owned()));
    // The variable that names the file is no setting.
    let settings = text.filter(|(name, _)| !name.eq_ignore_ascii_case("PERTURB_SERVER_CONFIG"));
    Environment::with_prefix(ENV_PREFIX)
        .prefix_separator("_")
        .try_parsing(true)
        .list_separator(",")
        .with_list_parse_key("listen")
        .with_list_parse_key("tasks")
        .source(Some(settings.collect()))
}

/// Where to listen.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
#[serde(try_from = "String")]
pub enum ListenAddress {
    /// A TCP address and port; port 0 = any free one.
    Tcp(SocketAddr),
    /// The path of a Unix socket.
    Unix(PathBuf),
}

impl TryFrom<String> for ListenAddress {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        if let Some(path) = text.strip_prefix("unix:") {
            let path = path.strip_prefix("//").unwrap_or(path);
            if !path.is_empty() {
                return Ok(Self::Unix(path.into()));
            }
        } else if let Ok(address) = text.strip_prefix("tcp://").unwrap_or(&text).parse() {
            return Ok(Self::Tcp(address));
        }
        Err(format!("{text:?} is no address to listen at; expected tcp://127.0.0.1:7447 or unix:/path/to/socket"))
    }
}

impl ListenAddress {
    /// As `--listen` takes it.
    pub fn written(&self) -> String {
        match self {
            Self::Tcp(address) => format!("tcp://{address}"),
            Self::Unix(path) => format!("unix:{}", path.display()),
        }
    }
}

impl fmt::Display for ListenAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "http://{address}"),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
        }
    }
}

/// The mode of a Unix socket's file: who may connect are those who may write.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct SocketMode(u32);

impl SocketMode {
    /// As the system takes it.
    pub fn bits(self) -> u32 {
        self.0
    }
}

impl Default for SocketMode {
    fn default() -> Self {
        Self(0o600)
    }
}

impl TryFrom<String> for SocketMode {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        // The owner may read and write, nobody execute; a number that was not octal is none of these.
        let bits = u32::from_str_radix(&text, 8).ok().filter(|bits| bits & !0o066 == 0o600);
        bits.map(Self).ok_or_else(|| format!("{text:?} is no mode of a socket; expected 0600, 0660, 0666, or so"))
    }
}

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A source cannot be read, or has an unknown key or a value of a wrong type.
    #[error("the configuration cannot be read: {0}; --help lists the settings")]
    Source(#[from] config::ConfigError),
    /// Other machines could use the server, or read along.
    #[error(
        "{address} can be reached by other machines, and {lacks}: give --tls-cert, --tls-key and --tokens (or \
         --tls-client-ca); or give --insecure, where everybody who reaches that address may use the server and read along"
    )]
    Insecure {
        /// Where it would listen.
        address: String,
        /// What is missing.
        lacks: &'static str,
    },
    /// Other machines could read the metrics.
    #[error(
        "{address} of --metrics can be reached by other machines, and metrics are neither encrypted nor is anybody asked \
         who reads them: give --metrics tcp://127.0.0.1:PORT or unix:/path; or give --insecure, where everybody who \
         reaches that address may read them"
    )]
    InsecureMetrics {
        /// Where they would be told.
        address: String,
    },
    /// A value is out of its range.
    #[error("{key} is {got}; expected {expected}")]
    Value {
        /// The setting.
        key: &'static str,
        /// What came.
        got: String,
        /// What would be right.
        expected: &'static str,
    },
}

impl Config {
    /// Merges defaults, file, environment variables and flags, and validates the result.
    ///
    /// # Errors
    /// [`Error`]: nothing has been bound or started.
    pub fn load(arguments: &Arguments) -> Result<Self, Error> {
        let mut builder = config::Config::builder();
        if arguments.private {
            builder = builder.add_source(File::from_str(PRIVATE, FileFormat::Toml));
        } else {
            if let Some(path) = &arguments.config {
                builder = builder.add_source(File::from(path.as_path()).format(FileFormat::Toml));
            }
            builder = builder.add_source(variables());
        }
        builder.add_source(config::Config::try_from(arguments)?).build()?.try_deserialize::<Self>()?.validated()
    }

    fn validated(self) -> Result<Self, Error> {
        let refuse = |key, got: &dyn ToString, expected| Err(Error::Value { key, got: got.to_string(), expected });
        if self.listen.is_empty() {
            return refuse("listen", &"empty", "at least one address");
        }
        if !(1..=1024).contains(&self.workers) {
            return refuse("workers", &self.workers, "1 … 1024");
        }
        if !(1..=1 << 24).contains(&self.max_envs) {
            return refuse("max_envs", &self.max_envs, "1 … 16777216");
        }
        if self.max_sessions == 0 {
            return refuse("max_sessions", &self.max_sessions, "at least 1");
        }
        if self.max_message_bytes < 1024 {
            return refuse("max_message_bytes", &self.max_message_bytes, "at least 1024");
        }
        if !(1..=MOST_SECONDS).contains(&self.keepalive_seconds) {
            return refuse("keepalive_seconds", &self.keepalive_seconds, "1 … 86400");
        }
        if self.max_memory < LEAST_MEMORY {
            return refuse("max_memory", &self.max_memory, "at least 1048576");
        }
        if !(1..=MOST_SECONDS).contains(&self.handshake_seconds) {
            return refuse("handshake_seconds", &self.handshake_seconds, "1 … 86400");
        }
        if self.stall_seconds > MOST_SECONDS {
            return refuse("stall_seconds", &self.stall_seconds, "at most 86400");
        }
        if self.lease_seconds > MOST_SECONDS {
            return refuse("lease_seconds", &self.lease_seconds, "at most 86400");
        }
        match (&self.tls_cert, &self.tls_key, &self.tls_client_ca) {
            (Some(_), None, _) => return refuse("tls_key", &"not given", "the private key of tls_cert"),
            (None, Some(_), _) => return refuse("tls_cert", &"not given", "the certificate of tls_key"),
            (None, None, Some(_)) => {
                return refuse("tls_cert", &"not given", "a certificate, as tls_client_ca needs TLS");
            }
            _ => {}
        }
        let asks = self.tokens.is_some() || self.tls_client_ca.is_some();
        let lacks = match (self.tls_cert.is_some(), asks) {
            _ if self.insecure => None,
            (true, true) => None,
            (true, false) => Some("this server would not ask who they are"),
            (false, true) => Some("tokens would go there unencrypted"),
            (false, false) => Some("this server would neither encrypt nor ask who they are"),
        };
        let others = |address: &&ListenAddress| match address {
            ListenAddress::Tcp(tcp) => !tcp.ip().to_canonical().is_loopback(),
            ListenAddress::Unix(_) => false,
        };
        if let (Some(lacks), Some(address)) = (lacks, self.listen.iter().find(others)) {
            return Err(Error::Insecure { address: address.written(), lacks });
        }
        if let Some(address) = self.metrics.as_ref().filter(others).filter(|_| !self.insecure) {
            return Err(Error::InsecureMetrics { address: address.written() });
        }
        if self.log.parse::<Targets>().is_err() {
            return refuse("log", &self.log, "error, warn, info, debug, trace, or a filter such as perturb=debug");
        }
        Ok(self)
    }

    /// The filter in full. A level is that of this program's own lines: what its libraries say mostly follows from what
    /// clients send, and of that only errors are logged unless a filter asks for more.
    pub fn filter(&self) -> Targets {
        match self.log.parse::<LevelFilter>() {
            Ok(level) => Targets::new().with_default(level.min(LevelFilter::ERROR)).with_target("perturb", level),
            Err(_) => self.log.parse().unwrap_or_default(), // `Config::load` has refused wrong filters
        }
    }

    /// The files of TLS, if it is asked for.
    pub fn tls(&self) -> Option<TlsFiles> {
        let (cert, key) = self.tls_cert.clone().zip(self.tls_key.clone())?;
        Some(TlsFiles { cert, key, client_ca: self.tls_client_ca.clone() })
    }

    /// The grace period.
    pub fn grace(&self) -> Duration {
        Duration::from_secs(self.grace_seconds)
    }
}

/// The files of TLS, in PEM.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsFiles {
    /// The server's certificate, and those between it and its authority's.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// The authorities one of which must have signed a client's certificate; none: clients need none.
    pub client_ca: Option<PathBuf>,
}

impl TlsFiles {
    /// In the order in which the server reads them.
    pub fn paths(&self) -> Vec<PathBuf> {
        [Some(&self.cert), Some(&self.key), self.client_ca.as_ref()].into_iter().flatten().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_has_what_the_narrowest_group_around_it_may_have() {
        let root = tempfile::tempdir().unwrap();
        let service = root.path().join("system.slice/perturb.service");
        std::fs::create_dir_all(&service).unwrap();
        let memory = || group_memory(root.path(), "1:name=systemd:/x\n0::/system.slice/perturb.service\n");
        assert_eq!(memory(), None);
        std::fs::write(service.join("memory.max"), "max\n").unwrap();
        assert_eq!(memory(), None);
        std::fs::write(service.parent().unwrap().join("memory.max"), "4096\n").unwrap();
        assert_eq!(memory(), Some(4096));
        std::fs::write(root.path().join("memory.max"), "8192\n").unwrap();
        assert_eq!(memory(), Some(4096));
        assert_eq!(group_memory(root.path(), ""), Some(8192), "a container sees its own group as the root");
    }

    #[test]
    fn a_level_is_that_of_our_own_lines_and_a_filter_stays_as_it_is() {
        for (log, filter) in [
            ("info", "error,perturb=info"),
            ("debug", "error,perturb=debug"),
            ("off", "off,perturb=off"),
            ("perturb=debug", "perturb=debug"),
            ("warn,h2=trace", "warn,h2=trace"),
        ] {
            let filter: Targets = filter.parse().unwrap();
            assert_eq!(Config { log: log.into(), ..Config::default() }.filter(), filter);
        }
    }
}
