//! Errors of requests about environments.

use super::DistributionError;
use perturb_protocol::names::UnknownEnvironment;

/// Maximum number of characters of a client's text that an error repeats.
const MAX_SHOWN_CHARS: usize = 100;

/// Shortens a client's text to [`MAX_SHOWN_CHARS`], for errors that repeat it.
pub(crate) fn shorten(text: &str) -> String {
    match text.char_indices().nth(MAX_SHOWN_CHARS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.into(),
    }
}

/// A refused request. Nothing was changed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No environment has this name.
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    /// The environment has no parameter of this name.
    #[error("{environment} has no parameter {name:?}; it has {known}")]
    UnknownParameter {
        /// The environment.
        environment: &'static str,
        /// The name that was requested.
        name: String,
        /// The names of the environment's parameters, separated by commas.
        known: String,
    },
    /// A distribution is not a union of intervals.
    #[error("the distribution of {parameter:?} is {}; expected {}", source.got, source.expected)]
    Distribution {
        /// The parameter.
        parameter: String,
        /// The fault of the distribution.
        source: DistributionError,
    },
    /// A parameter's value or interval leaves its physical range.
    #[error("parameter {parameter:?} of {environment} may reach {got} {unit}; give values within [{low}, {high}]")]
    OutOfRange {
        /// The environment.
        environment: &'static str,
        /// The parameter.
        parameter: &'static str,
        /// The offending end of an interval.
        got: f64,
        /// The parameter's unit.
        unit: &'static str,
        /// The minimum that is accepted.
        low: f64,
        /// The maximum that is accepted.
        high: f64,
    },
    /// A disturbance was requested in a session that was opened without disturbances.
    #[error(
        "{environment} was opened without disturbances, so that {name:?} cannot change; open it again with a \
         disturbance, such as {name:?} at its default"
    )]
    NotDisturbed {
        /// The environment.
        environment: &'static str,
        /// The disturbance that was asked for.
        name: String,
    },
    /// A parameter takes whole numbers, but an interval of its distribution contains none.
    #[error("parameter {parameter:?} of {environment} takes whole numbers, and {got} has none; give such as 2 or 0..4")]
    NotWhole {
        /// The environment.
        environment: &'static str,
        /// The parameter.
        parameter: &'static str,
        /// The interval.
        got: String,
    },
    /// A snapshot cannot be restored.
    #[error("the snapshot cannot be restored: {reason}; take a new one from a session of the same environment")]
    Snapshot {
        /// The fault of the snapshot.
        reason: String,
    },
    /// Two environments of a server would have the same name.
    #[error(
        "the name {name:?} is that of an environment that this server has already, {taken:?}; give it another name"
    )]
    NameTaken {
        /// The name of the new environment.
        name: &'static str,
        /// The name of the existing environment.
        taken: &'static str,
    },
    /// The environment could not be built.
    #[error("{environment} cannot be built: {reason}")]
    Model {
        /// The environment.
        environment: &'static str,
        /// The reason.
        reason: String,
    },
}

impl Error {
    /// Returns a conversion to the error of this parameter's distribution.
    pub(crate) fn in_distribution(parameter: &str) -> impl FnOnce(DistributionError) -> Self {
        move |source| Self::Distribution { parameter: shorten(parameter), source }
    }
}
