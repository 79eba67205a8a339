//! Errors between a client and its servers.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::time::Duration;

use tonic::{Code, Status};

use crate::address::Address;
use crate::escape::escape_lines;
use crate::names::UnknownEnvironment;
use crate::process_limit::spawn_failure;

/// Default timeout of a reply. Even a batch of thousands of environments replies much sooner.
pub const REPLY_TIMEOUT: Duration = Duration::from_secs(60);

/// A failure of a server, of the connection to it, or of a request.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the sentences say what the fields are")]
pub enum ClientError {
    /// No server answers at the address.
    #[error("no server answers at {address}: {reason}; start one with `{}`, or correct --server", address.start_command())]
    Connect { address: Address, reason: String },
    /// The program that answers at the address is no perturb-server.
    #[error(
        "what answers at {address} is no perturb-server: correct --server, or start one at a free port with \
         `perturb-server --listen tcp://127.0.0.1:0`"
    )]
    NotPerturb { address: Address },
    /// The server is not trusted, or does not trust this client.
    #[error("no safe connection to the server at {address}: {reason}")]
    Unsafe { address: Address, reason: String },
    /// Several servers were tried, and no server takes sessions.
    #[error(
        "no server answers ({reasons}); start one of them with `perturb-server --listen ADDRESS`, or correct --server"
    )]
    NoneConnects {
        /// Every address with its error.
        reasons: String,
    },
    /// The server understood a request and refused it. The session continues.
    #[error("the server at {address} refused {request}: {message}")]
    Refused { address: Address, request: &'static str, code: Code, message: String },
    /// The connection or the server is gone, and with it the session's environments.
    #[error("lost the server at {address} {}: {reason}", when(request))]
    Lost {
        address: Address,
        request: &'static str,
        /// The status that ended the stream.
        code: Code,
        reason: String,
    },
    /// A reply did not come in time.
    #[error("the server at {address} did not answer {request} within {} s", limit.as_secs_f64())]
    TimedOut { address: Address, request: &'static str, limit: Duration },
    /// The program was asked to end while it waited for a server.
    #[error("stopped by signal {signal} while {action}")]
    Stopped {
        signal: i32,
        /// The wait, as in "connecting".
        action: String,
    },
    /// A reply does not follow the protocol.
    #[error("the server at {address} answered {request} with {got}, expected {expected}: are both of one version?")]
    Protocol { address: Address, request: &'static str, got: String, expected: String },
    /// Servers of one run must serve the same environment.
    #[error("the servers at {first} and {other} describe {environment} differently: run one version of perturb-server")]
    Disagreement { first: Address, other: Address, environment: String },
    /// Servers of one run must serve the same model.
    #[error(
        "the servers at {first} and {other} have different models of {environment}, with the hashes {hashes:?}: give both \
         the same files of the task, and restart them"
    )]
    Models { first: Address, other: Address, environment: String, hashes: Box<[String; 2]> },
    /// The server has no such environment.
    #[error(transparent)]
    NoEnvironment(#[from] UnknownEnvironment),
    /// The server does not know [`Open::observe_parameters`](crate::proto::Open::observe_parameters).
    #[error(
        "the server at {address} cannot let a policy observe parameters: it is older than this program; run a \
         perturb-server of this version, or leave out `observe = \"parameters\"`"
    )]
    NoParameters { address: Address },
    /// The number of snapshots is not that of the environments.
    #[error("there are {got} snapshots to restore, expected {expected}: one for each environment")]
    Snapshots { got: usize, expected: usize },
    /// The program `perturb-server` was not found.
    #[error(
        "the program `perturb-server` was not found ({tried}): run `cargo build --release` first, set PERTURB_SERVER \
         to its path, or name a running server with --server"
    )]
    NoServerProgram {
        /// The places in which it was looked for.
        tried: String,
    },
    /// The private server did not start.
    #[error("the private server {} did not start: {reason}", program.display())]
    Start { program: PathBuf, reason: String },
    /// The private server refused folders of tasks.
    #[error(
        "perturb-server refused a task of {}, for the reason above; `perturb-server --task DIR --check` checks a folder",
        list(tasks)
    )]
    Tasks { tasks: Vec<PathBuf> },
    /// The operating system refused something that a client needs.
    #[error("cannot {action}: {}", spawn_failure(source))]
    System { action: &'static str, source: std::io::Error },
}

impl ClientError {
    /// The address and the reason, for a list of several.
    pub(crate) fn in_short(&self) -> String {
        match self {
            Self::Connect { address, reason } => format!("{address}: {reason}"),
            Self::Unsafe { address, reason } => format!("{address}: {reason}"),
            Self::NotPerturb { address } => format!("{address}: what answers there is no perturb-server"),
            other => other.to_string(),
        }
    }

    /// A single error for all addresses that were tried.
    pub fn from_all(mut errors: Vec<Self>) -> Self {
        if errors.len() == 1 || errors.iter().all(|error| matches!(error, Self::Unsafe { .. })) && !errors.is_empty() {
            return errors.remove(0);
        }
        Self::NoneConnects { reasons: errors.iter().map(Self::in_short).collect::<Vec<_>>().join("; ") }
    }

    /// The signal by which the program was asked to end, if that is the error.
    pub fn signal(&self) -> Option<i32> {
        if let Self::Stopped { signal, .. } = self { Some(*signal) } else { None }
    }

    /// Whether the request may succeed later or with another server: the request itself is not at fault.
    pub fn can_be_retried(&self) -> bool {
        match self {
            Self::Refused { code, .. } => *code == Code::ResourceExhausted, // full until other sessions end
            Self::Snapshots { .. } | Self::NoEnvironment(_) | Self::Unsafe { .. } => false,
            Self::Tasks { .. } | Self::Stopped { .. } => false,
            Self::Connect { .. }
            | Self::NotPerturb { .. } // a name may resolve to another machine later
            | Self::NoneConnects { .. }
            | Self::Lost { .. }
            | Self::TimedOut { .. }
            | Self::Protocol { .. } // a server of another version
            | Self::Disagreement { .. }
            | Self::Models { .. }
            | Self::NoParameters { .. } // a server of another version
            | Self::NoServerProgram { .. }
            | Self::Start { .. }
            | Self::System { .. } => true,
        }
    }

    /// Whether the server is gone or silent, or the connection to it. The session is lost, and the request may succeed when the
    /// server is back.
    pub fn is_absence(&self) -> bool {
        match self {
            Self::Lost { code, .. } => matches!(
                code,
                Code::Aborted
                    | Code::Cancelled
                    | Code::DataLoss
                    | Code::DeadlineExceeded
                    | Code::Internal
                    | Code::Unavailable
                    | Code::Unknown
            ),
            Self::Connect { .. } | Self::NoneConnects { .. } | Self::TimedOut { .. } | Self::Start { .. } => true,
            _ => false,
        }
    }
}

/// Paths, separated by commas.
fn list(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// The time of an error: "during a step", "when it was to save a player".
fn when(request: &str) -> String {
    if request.starts_with("to ") { format!("when it was {request}") } else { format!("during {request}") }
}

/// The reason why a call ended: the server's message, if there is one, escaped.
pub(crate) fn describe(status: &Status) -> String {
    match std::error::Error::source(status) {
        // Messages of the transport are about frames and streams, which does not help users.
        Some(cause) => system_words(cause).unwrap_or_else(|| "the connection broke off".into()),
        None if status.message().is_empty() => format!("{:?}", status.code()),
        None => escape_lines(status.message()),
    }
}

/// Describes the operating system's error of a connection, e.g. "nobody listens there". `None` if there is no such error.
pub(crate) fn system_words(error: &(dyn std::error::Error + 'static)) -> Option<String> {
    let mut chain = std::iter::successors(Some(error), |error| error.source());
    let system = chain.find_map(|error| error.downcast_ref::<std::io::Error>())?;
    Some(match system.kind() {
        ErrorKind::ConnectionRefused => "nobody listens there".into(),
        ErrorKind::NotFound => "there is no such socket".into(),
        ErrorKind::PermissionDenied => "this user may not open it".into(),
        ErrorKind::TimedOut => "it does not answer".into(),
        ErrorKind::ConnectionReset
        | ErrorKind::ConnectionAborted
        | ErrorKind::BrokenPipe
        | ErrorKind::NotConnected
        | ErrorKind::UnexpectedEof => "the connection broke off".into(),
        _ => system.to_string(),
    })
}

pub(crate) fn lost(address: &Address, request: &'static str, status: &Status) -> ClientError {
    if status.code() == Code::Unauthenticated {
        let address = address.clone();
        let code = status.code();
        let message = describe(status);
        return ClientError::Refused { address, request, code, message };
    }
    ClientError::Lost { address: address.clone(), request, code: status.code(), reason: describe(status) }
}

pub(crate) fn timed_out(address: &Address, request: &'static str, limit: Duration) -> ClientError {
    ClientError::TimedOut { address: address.clone(), request, limit }
}
