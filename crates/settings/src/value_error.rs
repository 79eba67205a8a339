//! The error for an invalid value in an experiment file, a configuration, a parameter set or a threshold.

use std::fmt::Display;

/// An invalid value, with the values that are accepted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} is {got}, but must be {expected}")]
pub struct ValueError {
    /// A name for the value in the message, e.g. "num_envs".
    pub what: String,
    /// The given value.
    pub got: String,
    /// The accepted values.
    pub expected: String,
}

impl ValueError {
    /// Creates the error for the value `got` of `what`.
    pub fn new(what: impl Into<String>, got: impl Display, expected: impl Into<String>) -> Self {
        Self { what: what.into(), got: got.to_string(), expected: expected.into() }
    }
}

/// Returns an error for the value `got` of `what` unless `accepted` is true. `expected` describes the accepted values.
pub fn require(
    accepted: bool,
    what: impl Into<String>,
    got: impl Display,
    expected: impl Into<String>,
) -> Result<(), ValueError> {
    if accepted { Ok(()) } else { Err(ValueError::new(what, got, expected)) }
}
