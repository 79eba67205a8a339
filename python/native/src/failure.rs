//! Failures as data. The package turns them into errors with sentences.

use perturb_protocol::{ClientError, Malformed};
use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(
    perturb._native,
    Failure,
    PyException,
    "Arguments: the kind of failure, a gRPC code or 0, and the other side's or the transport's words."
);

/// The server's sentence; the session lives on.
pub const REFUSED: &str = "refused";
/// No connection could be made.
pub const UNREACHABLE: &str = "unreachable";
/// The connection or the stream ended.
pub const LOST: &str = "lost";
/// A reply did not come in time.
pub const TIMED_OUT: &str = "timed out";
/// A reply of another kind.
pub const MISMATCH: &str = "mismatch";
/// A reply whose arrays have another length.
pub const MALFORMED: &str = "malformed";
/// A value that cannot be sent.
pub const INVALID: &str = "invalid";
/// The session has ended, is another process's, or another thread waits in it.
pub const UNUSABLE: &str = "unusable";

/// A policy that cannot be loaded, does not fit, or cannot act.
pub const POLICY: &str = "policy";

/// Why a request has no reply.
pub enum RequestFailure {
    /// The server's sentence; the session lives on.
    Refused(PyErr),
    /// The session has ended.
    Ended(PyErr),
}

impl RequestFailure {
    /// The failure for Python.
    pub fn into_error(self) -> PyErr {
        match self {
            Self::Refused(error) | Self::Ended(error) => error,
        }
    }
}

/// gRPC's code of a server that is not trusted, or does not trust.
const UNAUTHENTICATED: i32 = 16;

/// A failure for Python.
pub fn failure(kind: &'static str, code: i32, words: impl Into<String>) -> PyErr {
    Failure::new_err((kind, code, words.into()))
}

/// A reply whose content breaks the protocol.
pub fn malformed(error: &Malformed) -> PyErr {
    failure(MALFORMED, 0, format!("the server sent {error}"))
}

/// Converts an error of the protocol's client for Python.
pub fn from_client(error: &ClientError) -> PyErr {
    match error {
        ClientError::Refused { code, message, .. } => failure(REFUSED, *code as i32, message),
        ClientError::Lost { code, reason, .. } => failure(LOST, *code as i32, reason),
        ClientError::TimedOut { .. } => failure(TIMED_OUT, 0, ""),
        ClientError::Protocol { got, .. } => failure(MISMATCH, 0, got),
        ClientError::Connect { reason, .. } => failure(UNREACHABLE, 0, reason),
        ClientError::Unsafe { reason, .. } => failure(UNREACHABLE, UNAUTHENTICATED, reason),
        ClientError::NotPerturb { .. } => failure(UNREACHABLE, 0, "what answers there is no perturb-server"),
        other => failure(UNREACHABLE, 0, other.to_string()),
    }
}
