//! Errors of requests about environments.

use super::DistributionError;
use perturb_protocol::names::UnknownEnvironment;

/// Maximal number of characters that an error message quotes from a client's text.
const MAX_SHOWN_CHARS: usize = 100;

/// Shortens a client's text to [`MAX_SHOWN_CHARS`] characters, for error messages that quote it.
pub(crate) fn shorten(text: &str) -> String {
    match text.char_indices().nth(MAX_SHOWN_CHARS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.into(),
    }
}

/// The reason why a request about an environment is refused. A refused request changes nothing.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No environment has this name.
    #[error(transparent)]
    UnknownEnvironment(#[from] UnknownEnvironment),
    /// The environment has no parameter with this name.
    #[error("{environment} has no parameter {name:?}; it has {known}")]
    UnknownParameter {
        /// The environment's name.
        environment: &'static str,
        /// The requested name.
        name: String,
        /// The names of the environment's parameters, separated by commas.
        known: String,
    },
    /// A requested distribution is not a valid union of intervals.
    #[error("the distribution of {parameter:?} is {}; expected {}", source.got, source.expected)]
    Distribution {
        /// The name of the parameter that the distribution is for.
        parameter: String,
        /// The reason why the distribution is not valid.
        source: DistributionError,
    },
    /// A value or an interval is not within the parameter's physical range.
    #[error("parameter {parameter:?} of {environment} may reach {got} {unit}; give values within [{low}, {high}]")]
    OutOfRange {
        /// The environment's name.
        environment: &'static str,
        /// The parameter's name.
        parameter: &'static str,
        /// The value, or the end of the interval, that is out of range.
        got: f64,
        /// The parameter's unit.
        unit: &'static str,
        /// The accepted minimum.
        low: f64,
        /// The accepted maximum.
        high: f64,
    },
    /// A disturbance was requested in a session that was opened without disturbances.
    #[error(
        "{environment} was opened without disturbances, so {name:?} cannot change; open it again with a \
         disturbance, such as {name:?} at its default value"
    )]
    NotDisturbed {
        /// The environment's name.
        environment: &'static str,
        /// The requested disturbance.
        name: String,
    },
    /// A parameter takes whole numbers, but an interval of its distribution contains none.
    #[error(
        "parameter {parameter:?} of {environment} takes whole numbers, and {got} has none; give whole numbers, such as \
         2 or 0..4"
    )]
    NotWhole {
        /// The environment's name.
        environment: &'static str,
        /// The parameter's name.
        parameter: &'static str,
        /// The interval without whole numbers.
        got: String,
    },
    /// The distributions of all contexts take more memory than one environment may have.
    #[error(
        "the distributions of {environment} take {bytes} bytes; give fewer contexts or intervals, at most {limit} bytes"
    )]
    TooManyDistributions {
        /// The environment's name.
        environment: &'static str,
        /// The size of the distributions in a snapshot, in bytes.
        bytes: usize,
        /// The accepted maximum.
        limit: usize,
    },
    /// A snapshot cannot be restored.
    #[error("the snapshot cannot be restored: {reason}; take a new one from a session of the same environment")]
    Snapshot {
        /// The reason why the snapshot cannot be restored.
        reason: String,
    },
    /// Two environments of a server would have the same name.
    #[error("this server already has an environment {taken:?}; give {name:?} another name")]
    NameTaken {
        /// The name of the new environment.
        name: &'static str,
        /// The name of the existing environment.
        taken: &'static str,
    },
    /// The environment could not be created from its model.
    #[error("{environment} cannot be built: {reason}")]
    Model {
        /// The environment's name.
        environment: &'static str,
        /// The reason.
        reason: String,
    },
}

impl Error {
    /// Returns a function for `map_err` that adds the parameter's name to the error of a distribution.
    pub(crate) fn in_distribution(parameter: &str) -> impl FnOnce(DistributionError) -> Self {
        move |source| Self::Distribution { parameter: shorten(parameter), source }
    }
}
