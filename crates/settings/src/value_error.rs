//! The error for an invalid value in a plan, a configuration, a set or a threshold.

use std::fmt::Display;

/// A value that is not accepted.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} is {got}, but must be {expected}")]
pub struct ValueError {
    /// The name of the value.
    pub what: String,
    /// The given value.
    pub got: String,
    /// The accepted values.
    pub expected: String,
}

impl ValueError {
    /// The refusal of `got`, which was given for `what`.
    pub fn new(what: impl Into<String>, got: impl Display, expected: impl Into<String>) -> Self {
        Self { what: what.into(), got: got.to_string(), expected: expected.into() }
    }
}

/// Refuses a value unless it is `accepted`.
pub fn require(
    accepted: bool,
    what: impl Into<String>,
    got: impl Display,
    expected: impl Into<String>,
) -> Result<(), ValueError> {
    if accepted { Ok(()) } else { Err(ValueError::new(what, got, expected)) }
}
