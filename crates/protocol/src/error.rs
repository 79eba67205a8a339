//! Errors of a client that uses servers.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::time::Duration;

use tonic::{Code, Status};

use crate::address::Address;
use crate::escape::escape_lines;
use crate::names::UnknownEnvironment;
use crate::process_limit::spawn_failure;

/// Default maximal time to wait for a reply. Even a batch of thousands of environments replies much sooner.
pub const REPLY_TIMEOUT: Duration = Duration::from_secs(60);

/// A failure of a server, of the connection to it, or of a request.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the messages explain the fields")]
pub enum ClientError {
    /// No server answers at the address.
    #[error("no server answers at {address}: {reason}; start one with `{}`, or correct --server", address.start_command())]
    Connect { address: Address, reason: String },
    /// Another program than perturb-server answers at the address.
    #[error(
        "the program at {address} is not a perturb-server: correct --server, or start one at a free port with \
         `perturb-server --listen tcp://127.0.0.1:0`"
    )]
    NotPerturb { address: Address },
    /// The client does not trust the server, the server does not trust the client, or the client's credentials are
    /// unusable.
    #[error("no safe connection to the server at {address}: {reason}")]
    Unsafe { address: Address, reason: String },
    /// Several servers were tried, and none of them accepts sessions.
    #[error(
        "no server answers ({reasons}); start one of them with `perturb-server --listen ADDRESS`, or correct --server"
    )]
    NoneConnects {
        /// Each address and its error, separated by semicolons.
        reasons: String,
    },
    /// The server refused a request. The session continues.
    #[error("the server at {address} refused {request}: {message}")]
    Refused { address: Address, request: &'static str, code: Code, message: String },
    /// The connection to the server is lost, and with it the session's environments.
    #[error("lost the server at {address} {}: {reason}", when(request))]
    Lost {
        address: Address,
        request: &'static str,
        /// The gRPC status with which the stream ended.
        code: Code,
        reason: String,
    },
    /// A reply did not arrive within the timeout.
    #[error("the server at {address} did not answer {request} within {} s", limit.as_secs_f64())]
    TimedOut { address: Address, request: &'static str, limit: Duration },
    /// A signal asked the program to end while it waited for a server.
    #[error("stopped by signal {signal} while {action}")]
    Stopped {
        signal: i32,
        /// The name of the interrupted wait, such as "connecting".
        action: String,
    },
    /// A reply does not follow the protocol.
    #[error(
        "the server at {address} answered {request} with {got}, expected {expected}: do client and server have the same version?"
    )]
    Protocol { address: Address, request: &'static str, got: String, expected: String },
    /// The servers of one run describe an environment differently.
    #[error("the servers at {first} and {other} describe {environment} differently: run one version of perturb-server")]
    Disagreement { first: Address, other: Address, environment: String },
    /// The servers of one run have different models of an environment.
    #[error(
        "the servers at {first} and {other} have different models of {environment}, with the hashes {hashes:?}: give both \
         the same files of the task, and restart them"
    )]
    Models { first: Address, other: Address, environment: String, hashes: Box<[String; 2]> },
    /// The server has no environment with the requested name, or another revision of it than the requested one.
    #[error(transparent)]
    NoEnvironment(#[from] UnknownEnvironment),
    /// The server does not know [`Open::observe_parameters`](crate::proto::Open::observe_parameters).
    #[error(
        "the server at {address} cannot let a policy observe parameters: it is older than this program; run a \
         perturb-server of this version, or leave out `observe = \"parameters\"`"
    )]
    NoParameters { address: Address },
    /// The server does not know [`Open::contexts`](crate::proto::Open::contexts).
    #[error(
        "the server at {address} cannot train on a list of contexts: it is older than this program; run a \
         perturb-server of this version"
    )]
    NoContexts { address: Address },
    /// The number of snapshots differs from the number of environments to restore.
    #[error("there are {got} snapshots to restore, expected {expected}: one for each environment")]
    Snapshots { got: usize, expected: usize },
    /// The program `perturb-server` was not found.
    #[error(
        "the program `perturb-server` was not found ({tried}): run `cargo build --release` first, set PERTURB_SERVER \
         to its path, or name a running server with --server"
    )]
    NoServerProgram {
        /// The paths that were tried.
        tried: String,
    },
    /// The private server did not start.
    #[error("the private server {} did not start: {reason}", program.display())]
    Start { program: PathBuf, reason: String },
    /// The private server refused a task folder.
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
    /// Returns the address and the reason in short, for a list of several errors.
    pub(crate) fn in_short(&self) -> String {
        match self {
            Self::Connect { address, reason } => format!("{address}: {reason}"),
            Self::Unsafe { address, reason } => format!("{address}: {reason}"),
            Self::NotPerturb { address } => format!("{address}: the program there is not a perturb-server"),
            other => other.to_string(),
        }
    }

    /// Combines the errors of all addresses that were tried. Returns the first error if there is only one, or if all
    /// are [`ClientError::Unsafe`]; otherwise [`ClientError::NoneConnects`].
    pub fn from_all(mut errors: Vec<Self>) -> Self {
        if errors.len() == 1 || errors.iter().all(|error| matches!(error, Self::Unsafe { .. })) && !errors.is_empty() {
            return errors.remove(0);
        }
        Self::NoneConnects { reasons: errors.iter().map(Self::in_short).collect::<Vec<_>>().join("; ") }
    }

    /// The number of the signal in [`ClientError::Stopped`]; `None` for other errors.
    pub fn signal(&self) -> Option<i32> {
        if let Self::Stopped { signal, .. } = self { Some(*signal) } else { None }
    }

    /// Whether the same request may succeed later, or with another server.
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
            | Self::NoContexts { .. }
            | Self::NoServerProgram { .. }
            | Self::Start { .. }
            | Self::System { .. } => true,
        }
    }

    /// Whether the server does not answer or the connection to it is lost. Then the session is lost, too. The request
    /// may succeed when the server is back.
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

/// Joins paths with commas.
fn list(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// Returns when an error occurred, such as "during a step" or "when it was to save a player", from the name of a
/// request.
fn when(request: &str) -> String {
    if request.starts_with("to ") { format!("when it was {request}") } else { format!("during {request}") }
}

/// Returns why a call failed: the system's error if the connection failed, otherwise the server's message, escaped for
/// terminals.
pub(crate) fn describe(status: &Status) -> String {
    match std::error::Error::source(status) {
        // The transport's messages are about HTTP/2 frames and streams. They do not help users, so they are not shown.
        Some(cause) => system_words(cause).unwrap_or_else(|| "the connection broke off".into()),
        None if status.message().is_empty() => format!("{:?}", status.code()),
        None => escape_lines(status.message()),
    }
}

/// Describes the operating system's error that caused `error`, such as "nobody listens there". Returns `None` if no
/// such error is among its sources.
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
