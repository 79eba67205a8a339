//! Errors of a policy's arrays and numbers.

/// A failure of a policy, a normaliser or a gradient step.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A part of a policy's shape is empty.
    #[error("{name} is 0, but must be at least 1")]
    Empty {
        /// The part.
        name: &'static str,
    },
    /// An array has the wrong number of elements.
    #[error("{name} has {got} elements, expected {expected}")]
    Length {
        /// The array, with its axes, e.g. "observations `[N, O]`".
        name: &'static str,
        /// Elements that were given.
        got: usize,
        /// Elements that were expected.
        expected: usize,
    },
    /// Saved arrays do not fit: one is missing, superfluous, misnamed or has another shape.
    #[error("array {position} is {got}, expected {expected}; were these saved with other settings?")]
    Arrays {
        /// Place in the list.
        position: usize,
        /// Name and shape that were found, or "missing".
        got: String,
        /// Name and shape that were expected, or "nothing".
        expected: String,
    },
    /// A number that must be finite is not.
    #[error("{what} became {value} at update {update}; lower the learning rate, or look for very large rewards")]
    NotFinite {
        /// The quantity, e.g. "the loss".
        what: &'static str,
        /// The value: NaN, inf or -inf.
        value: f64,
        /// Index of the gradient step, from 0.
        update: u64,
    },
    /// A policy gave a log-probability or a value that is infinite or NaN.
    #[error(
        "the policy's output in environment {environment} is not finite; its weights or observation hold NaN or inf"
    )]
    PolicyOutput {
        /// The environment, 0 … N-1.
        environment: usize,
    },
    /// The policy cannot act, because its networks were moved out of it.
    #[error("the policy's networks were moved out of it; load weights before it acts again")]
    NoWeights,
    /// A gradient of no samples was asked for.
    #[error("a minibatch is empty, but must have at least 1 sample")]
    NoSamples,
    /// The system starts no more threads.
    #[error("{wanted} threads cannot be started: {reason}; ask for fewer")]
    Threads {
        /// Number of threads to start.
        wanted: usize,
        /// The system's message.
        reason: String,
    },
    /// Nothing is registered that differentiates recurrent policies.
    #[error("this program cannot train recurrent policies: use perturb-recurrent, which has libtorch")]
    NoRecurrentGradients,
    /// The library that differentiates recurrent policies refused an operation.
    #[error("{library}: {reason}")]
    Library {
        /// The library's name.
        library: &'static str,
        /// The library's message.
        reason: String,
    },
    /// Impossible statistics.
    #[error("the statistics of {name} are invalid: {reason}")]
    Statistics {
        /// The normalised quantity: observations or rewards.
        name: &'static str,
        /// The reason.
        reason: String,
    },
    /// An input that must be finite is not.
    #[error("{name} hold {value}; the environment's numbers must be finite")]
    Input {
        /// The array, with its axes.
        name: &'static str,
        /// The first element that is not finite.
        value: f32,
    },
}

/// A result with this module's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// `Ok` if a slice has the expected length.
///
/// # Errors
/// [`Error::Length`] otherwise.
pub fn check_length(name: &'static str, got: usize, expected: usize) -> Result<()> {
    if got == expected { Ok(()) } else { Err(Error::Length { name, got, expected }) }
}
