//! The exception `Failure` of the native module. The Python package converts it to its own errors with full messages.

use perturb_protocol::{ClientError, Malformed};
use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(
    perturb._native,
    Failure,
    PyException,
    "A failure of the native module. Its arguments are the kind of failure, a gRPC status code or 0, and a message."
);

/// Kind of failure: the server refused a request. The message has the reason. The session can be used further.
pub const REFUSED: &str = "refused";
/// Kind of failure: no connection could be made.
pub const UNREACHABLE: &str = "unreachable";
/// Kind of failure: the connection or the stream ended.
pub const LOST: &str = "lost";
/// Kind of failure: a reply did not come in time.
pub const TIMED_OUT: &str = "timed out";
/// Kind of failure: the server sent the reply to another kind of request.
pub const MISMATCH: &str = "mismatch";
/// Kind of failure: a reply has invalid content, such as an array of a wrong length.
pub const MALFORMED: &str = "malformed";
/// Kind of failure: an argument is invalid.
pub const INVALID: &str = "invalid";
/// Kind of failure: an object does not permit the call in its present state. For example, a session has ended, belongs
/// to another process, or is in use by another thread.
pub const UNUSABLE: &str = "unusable";
/// Kind of failure: a policy cannot be loaded, does not fit the environment, or cannot act.
pub const POLICY: &str = "policy";

/// The reason why a request has no reply.
pub enum RequestFailure {
    /// The server refused the request. The session can be used further.
    Refused(PyErr),
    /// The session has ended.
    Ended(PyErr),
}

impl RequestFailure {
    /// Returns the Python error.
    pub fn into_error(self) -> PyErr {
        match self {
            Self::Refused(error) | Self::Ended(error) => error,
        }
    }
}

/// The gRPC status code for failed authentication: the client does not trust the server, or the server refuses the
/// client.
const UNAUTHENTICATED: i32 = 16;

/// Makes a `Failure` exception from its kind, gRPC status code and message.
pub fn failure(kind: &'static str, code: i32, words: impl Into<String>) -> PyErr {
    Failure::new_err((kind, code, words.into()))
}

/// Makes the `Failure` exception for a reply that breaks the protocol.
pub fn malformed(error: &Malformed) -> PyErr {
    failure(MALFORMED, 0, format!("the server sent {error}"))
}

/// Converts an error of the protocol's client to a `Failure` exception.
pub fn from_client(error: &ClientError) -> PyErr {
    match error {
        ClientError::Refused { code, message, .. } => failure(REFUSED, *code as i32, message),
        ClientError::Lost { code, reason, .. } => failure(LOST, *code as i32, reason),
        ClientError::TimedOut { .. } => failure(TIMED_OUT, 0, ""),
        ClientError::Protocol { got, .. } => failure(MISMATCH, 0, got),
        ClientError::Connect { reason, .. } => failure(UNREACHABLE, 0, reason),
        ClientError::Unsafe { reason, .. } => failure(UNREACHABLE, UNAUTHENTICATED, reason),
        ClientError::NotPerturb { .. } => failure(UNREACHABLE, 0, "the program there is not a perturb-server"),
        other => failure(UNREACHABLE, 0, other.to_string()),
    }
}
