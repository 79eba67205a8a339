//! The server's configuration. Its sources are defaults, a TOML file, environment variables and command-line flags.
//! Each source overrides the sources before it.

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
/// The maximum of timeouts and intervals, s: one day. The transport adds them to the present time, which must not
/// overflow.
const MAX_SECONDS: u64 = 86_400;
/// The minimum of `max_memory`, bytes. A server that draws pictures needs more.
const MIN_MEMORY: usize = 1 << 20;
/// The number of cores for each transport thread, by default. The number is high, because physics needs most of the
/// cores.
const CORES_PER_TRANSPORT_THREAD: usize = 8;
/// The maximum number of transport threads. More would not have enough to do on any machine.
const MAX_TRANSPORT_THREADS: usize = 128;
/// The maximum length of the configuration file, bytes.
const MAX_CONFIG_BYTES: u64 = 1 << 20;
/// The settings of `--private`. These settings remove the limits, which protect only shared servers. Timeouts are long,
/// because the program that started the server may compute for long between two steps. If this program dies, its socket
/// and pipe are closed without a timeout.
const PRIVATE: &str = "
    exit_with_stdin = true
    transport_threads = 1
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
/// Every flag can also be set in the TOML file of --config (`max_envs = 64`) or by an environment variable
/// (`PERTURB_SERVER_MAX_ENVS=64`). Flags override variables, variables override the file.
#[derive(Debug, Default, Parser, Serialize)]
#[command(name = "perturb-server", version = crate::VERSION)]
pub struct Arguments {
    /// A TOML file with settings.
    #[arg(long, value_name = "FILE", env = "PERTURB_SERVER_CONFIG")]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Address to listen on: unix:/path/to/socket, or tcp://address:port; port 0 takes a free port. Repeatable. The
    /// server prints its addresses on standard output. [default: tcp://127.0.0.1:7447]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub listen: Vec<String>,
    /// Number of physics threads. [default: one for each core]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub workers: Option<usize>,
    /// Number of transport threads, which talk to clients. A connection stays on one of them. [default: one for each
    /// eight cores, at least one]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transport_threads: Option<usize>,
    /// Maximum number of environments, over all sessions. [default: 16384]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_envs: Option<usize>,
    /// Maximum number of sessions at a time. [default: 1024]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_sessions: Option<usize>,
    /// Maximum size of a request, in bytes. [default: 67108864]
    #[arg(long, value_name = "BYTES")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_message_bytes: Option<usize>,
    /// Maximum number of bytes in flight, over all sessions: requests, replies, pictures, and policies that the server
    /// runs. Further requests are refused. [default: a quarter of the memory of the machine, or of the container's
    /// limit]
    #[arg(long, value_name = "BYTES")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_memory: Option<usize>,
    /// Maximum number of sessions of one client machine, or of one local user over a Unix socket; 0 = --max-sessions.
    /// [default: 0]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_peer_sessions: Option<usize>,
    /// Time within which a client must finish the handshake of a connection, and then open a session. [default: 10]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub handshake_seconds: Option<u64>,
    /// Time within which a client must finish sending a request, or read a reply; 0 = no limit. [default: 300]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stall_seconds: Option<u64>,
    /// Time for which running sessions may continue after SIGTERM. [default: 30]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grace_seconds: Option<u64>,
    /// Time after which a session that sends no request is ended; 0 = no limit. [default: 0]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub idle_seconds: Option<u64>,
    /// Time for which a session with a lease survives the loss of its connection, so that its client can resume it; 0 =
    /// no leases. [default: 60]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lease_seconds: Option<u64>,
    /// Interval of keepalive pings on idle connections. A connection that does not answer within this time is closed,
    /// and its environments are freed. [default: 60]
    #[arg(long, value_name = "SECONDS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keepalive_seconds: Option<u64>,
    /// TOML file of tokens. Every call over TCP must carry one of them. Each token has a name and sha256 (or token),
    /// and optionally max_sessions, max_envs, max_steps_per_second, max_bytes, and a role that limits the parameters it
    /// may draw. The file is read again when it changes.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tokens: Option<PathBuf>,
    /// File in which the server records every draw of parameters before it happens, with token, distribution, seed,
    /// indices and episodes. Its lines form a hash chain. `perturb audit --ledger` reads it. An existing file is
    /// continued.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ledger: Option<PathBuf>,
    /// The server's certificate for TLS on its TCP addresses, in PEM, with the intermediate certificates. The TLS files
    /// are read again when they change.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_cert: Option<PathBuf>,
    /// The private key of --tls-cert, in PEM.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_key: Option<PathBuf>,
    /// Certificates in PEM of the authorities that may sign clients' certificates. If not given, clients need no
    /// certificate.
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_client_ca: Option<PathBuf>,
    /// Address at which Prometheus reads the metrics, under the path /metrics: tcp://127.0.0.1:port or unix:/path.
    /// Everybody who can connect can read them. [default: none]
    #[arg(long, value_name = "ADDRESS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics: Option<String>,
    /// Allow other machines to use this server without tokens or without encryption.
    #[arg(long)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub insecure: bool,
    /// Octal permissions of Unix socket files: 0660 admits the group, 0666 everybody. [default: 0600]
    #[arg(long, value_name = "MODE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub socket_mode: Option<String>,
    /// Level of the log on standard error: error, warn, info, debug, trace, or a filter such as perturb=debug.
    /// [default: info]
    #[arg(long, value_name = "FILTER")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log: Option<String>,
    /// Shut down when standard input closes. A server that a program starts through a pipe then ends with that program,
    /// even if the program crashes.
    #[arg(long)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub exit_with_stdin: bool,
    /// Serve only the program that starts this server: implies --exit-with-stdin, removes limits, allows an hour of
    /// silence between two requests, and shuts down within a second. The server then ignores environment variables and
    /// --config.
    #[arg(long)]
    #[serde(skip)]
    pub private: bool,
    /// Folder with an MJCF model and a file task.toml, to be served as an additional environment; see docs/tasks.md.
    /// Repeatable.
    #[arg(long = "task", value_name = "FOLDER")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tasks: Vec<PathBuf>,
    /// Instead of starting a server, load the folders of --task, each in a process of its own, and describe them:
    /// observations, actions, rewards, parameters, sizes, speed, and parameters without an effect.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub check: bool,
    /// Instead of starting a server, print a JSON schema of task.toml.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub task_schema: bool,
    /// Load this folder under limits of memory and CPU time, and describe it. A server runs itself with this flag
    /// before it loads a folder.
    #[arg(long, value_name = "FOLDER", group = "instead", hide = true)]
    #[serde(skip)]
    pub check_task: Option<PathBuf>,
    /// With --check-task, also measure the speed of the environment.
    #[arg(long, hide = true, requires = "check_task")]
    #[serde(skip)]
    pub measure_task: bool,
    /// Instead of starting a server, check whether the running server with these settings accepts sessions, at its
    /// first address. The exit status is 0 if it does, otherwise 1. For health checks of containers.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub health: bool,
    /// Instead of starting a server, print as JSON what it would serve: the environments with their spaces, parameters
    /// and success rules, and the limits that clients must keep.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub catalogue: bool,
    /// Instead of starting a server, print its protocol, perturb/v1/perturb.proto, from which clients in any language
    /// can be generated.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub proto: bool,
    /// Instead of starting a server, print a new token on standard output, and its entry for the file of --tokens on
    /// standard error.
    #[arg(long, value_name = "NAME", group = "instead")]
    #[serde(skip)]
    pub new_token: Option<String>,
    /// Instead of starting a server, print the shell completions of these flags.
    #[arg(long, value_name = "SHELL", group = "instead")]
    #[serde(skip)]
    pub completions: Option<clap_complete::Shell>,
    /// Instead of starting a server, print the manual page.
    #[arg(long, group = "instead")]
    #[serde(skip)]
    pub man: bool,
}

/// The validated configuration of a server.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The addresses to listen on, at least one.
    pub listen: Vec<ListenAddress>,
    /// The number of physics threads, 1 … 1024.
    pub workers: usize,
    /// The number of transport threads, which talk to clients, 1 … 128.
    pub transport_threads: usize,
    /// Maximum number of environments, over all sessions, 1 … 2^24.
    pub max_envs: usize,
    /// Maximum number of sessions at a time, at least 1.
    pub max_sessions: usize,
    /// Maximum size of a request in bytes, at least 1024.
    pub max_message_bytes: usize,
    /// Maximum number of bytes in flight, at least 1 MiB.
    pub max_memory: usize,
    /// Maximum number of sessions of one peer (machine or user); 0 = `max_sessions`.
    pub max_peer_sessions: usize,
    /// Time within which a client must finish the handshake of a connection, and then open a session, s, 1 … 86400.
    pub handshake_seconds: u64,
    /// Time within which a client must finish sending a request, or read a reply, s, at most 86400; 0 = no limit.
    pub stall_seconds: u64,
    /// Time for which running sessions may continue after SIGTERM, s.
    pub grace_seconds: u64,
    /// Time after which a session that sends no request is ended, s; 0 = no limit.
    pub idle_seconds: u64,
    /// Time for which a session with a lease survives the loss of its connection, s, at most 86400; 0 = no leases.
    pub lease_seconds: u64,
    /// Interval of keepalive pings on idle connections, s, 1 … 86400.
    pub keepalive_seconds: u64,
    /// The token file; if `None`, calls need no token.
    pub tokens: Option<PathBuf>,
    /// The ledger file, which records all draws.
    pub ledger: Option<PathBuf>,
    /// The server's certificate for TLS.
    pub tls_cert: Option<PathBuf>,
    /// The private key of `tls_cert`.
    pub tls_key: Option<PathBuf>,
    /// The authorities that may sign clients' certificates.
    pub tls_client_ca: Option<PathBuf>,
    /// The address of the metrics page; `None` for no metrics.
    pub metrics: Option<ListenAddress>,
    /// Whether other machines may use this server without tokens or without encryption.
    pub insecure: bool,
    /// The permissions of Unix socket files.
    pub socket_mode: SocketMode,
    /// The log filter.
    pub log: String,
    /// Whether to shut down when standard input closes.
    pub exit_with_stdin: bool,
    /// The folders of tasks that are served in addition to the built-in environments.
    pub tasks: Vec<PathBuf>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: vec![ListenAddress::Tcp(SocketAddr::from(([127, 0, 0, 1], DEFAULT_PORT)))],
            workers: cores(),
            transport_threads: (cores() / CORES_PER_TRANSPORT_THREAD).clamp(1, MAX_TRANSPORT_THREADS),
            max_envs: DEFAULT_MAX_ENVS,
            max_sessions: 1024,
            max_message_bytes: DEFAULT_MAX_MESSAGE_BYTES,
            max_memory: default_memory(),
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

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Returns a quarter of the machine's memory or, if lower, of the memory limit of this process's container or service,
/// bytes.
fn default_memory() -> usize {
    let rustix::system::Sysinfo { totalram, mem_unit, .. } = rustix::system::sysinfo();
    let machine = (totalram as usize).saturating_mul(mem_unit as usize);
    let groups = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let group = group_memory(Path::new("/sys/fs/cgroup"), &groups);
    (group.unwrap_or(machine).min(machine) / 4).max(MIN_MEMORY)
}

/// Returns the lowest memory limit of this process's control group and its ancestors, bytes. `groups` is the text of
/// `/proc/self/cgroup`.
fn group_memory(root: &Path, groups: &str) -> Option<usize> {
    let own = groups.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default();
    let around = Path::new(own).ancestors().map(|group| root.join(group).join("memory.max"));
    around.filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse().ok()).min()
}

/// Returns the environment variables that are settings.
fn variables() -> Environment {
    // Variables of other programs need not be UTF-8. A setting that is not UTF-8 gets replacement characters and is
    // then refused.
    let text = std::env::vars_os().map(|(k, v)| (k.to_string_lossy().into_owned(), v.to_string_lossy().into_owned()));
    // PERTURB_SERVER_CONFIG names the configuration file, and is not itself a setting.
    let settings = text
        .filter(|(name, value)| !name.eq_ignore_ascii_case("PERTURB_SERVER_CONFIG") && !is_service_link(name, value));
    Environment::with_prefix(ENV_PREFIX)
        .prefix_separator("_")
        .try_parsing(true)
        .list_separator(",")
        .with_list_parse_key("listen")
        .with_list_parse_key("tasks")
        .source(Some(settings.collect()))
}

/// Whether Kubernetes has set this variable. It sets such variables in every container if a Service has a name that
/// begins with `perturb-server`: e.g. `PERTURB_SERVER_PORT=tcp://10.96.3.7:7447` or `PERTURB_SERVER_SERVICE_HOST`.
fn is_service_link(name: &str, value: &str) -> bool {
    let Some(rest) = name.strip_prefix(ENV_PREFIX) else { return false };
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let is_port = |rest: &str| {
        // Kubernetes' names continue with `NUMBER_PROTOCOL`, optionally followed by `_PROTO`, `_PORT` or `_ADDR`.
        let mut parts = rest.split('_');
        parts.next().is_some_and(is_number)
            && parts.next().is_some_and(|protocol| matches!(protocol, "TCP" | "UDP" | "SCTP"))
            && matches!(parts.next(), None | Some("PROTO" | "PORT" | "ADDR"))
            && parts.next().is_none()
    };
    rest.ends_with("_SERVICE_HOST")
        || rest.ends_with("_SERVICE_PORT")
        || rest.contains("_SERVICE_PORT_")
        || (rest.ends_with("_PORT") && value.contains("://"))
        || rest.match_indices("_PORT_").any(|(at, separator)| is_port(&rest[at + separator.len()..]))
}

/// An address to listen on.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Deserialize)]
#[serde(try_from = "String")]
pub enum ListenAddress {
    /// A TCP address and port; port 0 stands for any free port.
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
        Err(format!("{text:?} is not an address to listen at; expected tcp://127.0.0.1:7447 or unix:/path/to/socket"))
    }
}

impl ListenAddress {
    /// Returns the address in the syntax of `--listen`.
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

/// The permissions of a Unix socket's file. Users who may write to the file may connect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct SocketMode(u32);

impl SocketMode {
    /// Returns the permission bits.
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
        // The owner must be able to read and write, and nobody may execute.
        let bits = u32::from_str_radix(&text, 8).ok().filter(|bits| bits & !0o066 == 0o600);
        bits.map(Self).ok_or_else(|| {
            format!("{text:?} is not a mode of a socket; expected an octal mode such as 0600, 0660 or 0666")
        })
    }
}

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A source of settings cannot be read, or has an unknown key or a value of a wrong type.
    #[error("the configuration cannot be read: {0}; --help lists the settings")]
    Source(#[from] config::ConfigError),
    /// The configuration file is a pipe, a device or a folder, or it is too large.
    #[error("cannot read {path}: {reason}; correct --config")]
    File {
        /// The path of the file.
        path: String,
        /// The cause.
        reason: String,
    },
    /// Other machines could use the server, or eavesdrop on its connections.
    #[error(
        "{address} can be reached by other machines, and {lacks}: pass --tls-cert, --tls-key and --tokens (or \
         --tls-client-ca); or pass --insecure if everybody who reaches that address may use the server and read along"
    )]
    Insecure {
        /// The address that the server would listen on.
        address: String,
        /// The missing protection, as a part of a sentence.
        lacks: &'static str,
    },
    /// Other machines could read the metrics.
    #[error(
        "{address} of --metrics can be reached by other machines, and metrics need no token and are not encrypted: pass \
         --metrics tcp://127.0.0.1:PORT or unix:/path; or pass --insecure if everybody who reaches that address may \
         read them"
    )]
    InsecureMetrics {
        /// The address of `--metrics`.
        address: String,
    },
    /// A value is out of its range.
    #[error("{key} is {got}; expected {expected}")]
    Value {
        /// The name of the setting.
        key: &'static str,
        /// The value of the setting.
        got: String,
        /// The values that are allowed.
        expected: &'static str,
    },
}

/// Checks that the configuration file is a regular file and not too large.
fn require_plain_file(path: &Path) -> Result<(), Error> {
    let refused = |error: std::io::Error| Error::File { path: path.display().to_string(), reason: error.to_string() };
    perturb_system::read_plain(path, MAX_CONFIG_BYTES).map(drop).map_err(refused)
}

impl Config {
    /// Merges the defaults, the configuration file, environment variables and flags, and validates the result.
    ///
    /// # Errors
    /// [`Error`], if a source cannot be read or a value is invalid.
    pub fn load(arguments: &Arguments) -> Result<Self, Error> {
        let mut builder = config::Config::builder();
        if arguments.private {
            builder = builder.add_source(File::from_str(PRIVATE, FileFormat::Toml));
        } else {
            if let Some(path) = &arguments.config {
                require_plain_file(path)?;
                builder = builder.add_source(File::from(path.as_path()).format(FileFormat::Toml));
            }
            builder = builder.add_source(variables());
        }
        builder.add_source(config::Config::try_from(arguments)?).build()?.try_deserialize::<Self>()?.validated()
    }

    /// Checks the ranges of all values, and that other machines cannot use an unprotected server.
    fn validated(self) -> Result<Self, Error> {
        let refuse = |key, got: &dyn ToString, expected| Err(Error::Value { key, got: got.to_string(), expected });
        if self.listen.is_empty() {
            return refuse("listen", &"empty", "at least one address");
        }
        if !(1..=1024).contains(&self.workers) {
            return refuse("workers", &self.workers, "1 … 1024");
        }
        if !(1..=MAX_TRANSPORT_THREADS).contains(&self.transport_threads) {
            return refuse("transport_threads", &self.transport_threads, "1 … 128: about one for each eight cores");
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
        if !(1..=MAX_SECONDS).contains(&self.keepalive_seconds) {
            return refuse("keepalive_seconds", &self.keepalive_seconds, "1 … 86400");
        }
        if self.max_memory < MIN_MEMORY {
            return refuse("max_memory", &self.max_memory, "at least 1048576");
        }
        if !(1..=MAX_SECONDS).contains(&self.handshake_seconds) {
            return refuse("handshake_seconds", &self.handshake_seconds, "1 … 86400");
        }
        if self.stall_seconds > MAX_SECONDS {
            return refuse("stall_seconds", &self.stall_seconds, "at most 86400");
        }
        if self.lease_seconds > MAX_SECONDS {
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
        let authenticates = self.tokens.is_some() || self.tls_client_ca.is_some();
        let lacks = match (self.tls_cert.is_some(), authenticates) {
            _ if self.insecure => None,
            (true, true) => None,
            (true, false) => Some("this server would not authenticate them"),
            (false, true) => Some("tokens would be sent unencrypted"),
            (false, false) => Some("this server would neither encrypt connections nor authenticate them"),
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

    /// Returns the filter of log lines. If the setting is a level, the level applies to this program's own lines. Of
    /// its libraries, only errors are logged, because most other lines of libraries are caused by data from clients.
    pub fn filter(&self) -> Targets {
        match self.log.parse::<LevelFilter>() {
            Ok(level) => Targets::new().with_default(level.min(LevelFilter::ERROR)).with_target("perturb", level),
            Err(_) => self.log.parse().unwrap_or_default(), // cannot fail: `Config::load` has checked the filter
        }
    }

    /// Returns the TLS files, or `None` if TLS is not configured.
    pub fn tls(&self) -> Option<TlsFiles> {
        let (cert, key) = self.tls_cert.clone().zip(self.tls_key.clone())?;
        Some(TlsFiles { cert, key, client_ca: self.tls_client_ca.clone() })
    }

    /// The grace period of a shutdown.
    pub fn grace(&self) -> Duration {
        Duration::from_secs(self.grace_seconds)
    }
}

/// The paths of the TLS files, which are in PEM.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsFiles {
    /// The server's certificate, and the intermediate certificates.
    pub cert: PathBuf,
    /// The private key of `cert`.
    pub key: PathBuf,
    /// The authorities that may sign clients' certificates; if `None`, clients need no certificate.
    pub client_ca: Option<PathBuf>,
}

impl TlsFiles {
    /// Returns the paths of the certificate, the key and the authorities (if any), in this order.
    pub fn paths(&self) -> Vec<PathBuf> {
        [Some(&self.cert), Some(&self.key), self.client_ca.as_ref()].into_iter().flatten().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn service_has_the_lowest_memory_limit_around_it() {
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
    fn variables_of_kubernetes_services_are_no_settings() {
        let address = "tcp://10.96.3.7:7447";
        for (name, value) in [
            ("PERTURB_SERVER_PORT", address),
            ("PERTURB_SERVER_SERVICE_HOST", "10.96.3.7"),
            ("PERTURB_SERVER_SERVICE_PORT", "7447"),
            ("PERTURB_SERVER_SERVICE_PORT_GRPC", "7447"),
            ("PERTURB_SERVER_PORT_7447_TCP", address),
            ("PERTURB_SERVER_PORT_7447_TCP_PROTO", "tcp"),
            ("PERTURB_SERVER_PORT_7447_UDP_PORT", "7447"),
            ("PERTURB_SERVER_PORT_7447_TCP_ADDR", "10.96.3.7"),
            ("PERTURB_SERVER_METRICS_SERVICE_HOST", "10.96.3.8"),
            ("PERTURB_SERVER_METRICS_PORT", "tcp://10.96.3.8:9447"),
            ("PERTURB_SERVER_METRICS_PORT_9447_TCP_ADDR", "10.96.3.8"),
        ] {
            assert!(is_service_link(name, value), "{name}");
        }
        for (name, value) in [
            ("PERTURB_SERVER_PORT", "7447"),
            ("PERTURB_SERVER_MAX_ENV", "3"),
            ("PERTURB_SERVER_LISTEN", address),
            ("PERTURB_SERVER_METRICS", address),
            ("PERTURB_SERVER_PORT_7447", "7447"),
            ("PERTURB_SERVER_PORT_7447_TCP_X", "7447"),
        ] {
            assert!(!is_service_link(name, value), "{name}");
        }
    }

    #[test]
    fn level_applies_to_own_lines_and_filter_stays() {
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
