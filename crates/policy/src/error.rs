//! Errors of policies, normalisers and gradients.

/// A failure of a policy, a normaliser or a gradient step.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A size in a policy's shape is 0.
    #[error("{name} is 0, but must be at least 1")]
    Empty {
        /// The name of the size.
        name: &'static str,
    },
    /// An array has the wrong number of elements.
    #[error("{name} has {got} elements, expected {expected}")]
    Length {
        /// The array, with its axes, e.g. "observations `[N, O]`".
        name: &'static str,
        /// Number of elements in the array.
        got: usize,
        /// Number of elements that it must have.
        expected: usize,
    },
    /// Saved arrays do not match the expected ones: one is missing, superfluous or misnamed, or has the wrong shape.
    #[error("array {position} is {got}, expected {expected}; were these saved with other settings?")]
    Arrays {
        /// Index of the first wrong array in the list.
        position: usize,
        /// Name and shape of the saved array, or "missing".
        got: String,
        /// Name and shape of the expected array, or "nothing".
        expected: String,
    },
    /// A loss or a gradient is infinite or NaN.
    #[error("{what} became {value} at update {update}; lower the learning rate, or look for very large rewards")]
    NotFinite {
        /// The quantity, e.g. "the loss".
        what: &'static str,
        /// The value: NaN, inf or -inf.
        value: f64,
        /// Index of the gradient step, from 0.
        update: u64,
    },
    /// A policy computed an action, a log-probability or a value that is infinite or NaN.
    #[error(
        "the policy's output in environment {environment} is not finite; its weights or observation hold NaN or inf"
    )]
    PolicyOutput {
        /// The index of the environment, 0 … N-1.
        environment: usize,
    },
    /// The policy's networks were moved to a gradient backend. Load weights before it acts again.
    #[error("the policy's networks were moved out of it; load weights before it acts again")]
    NoWeights,
    /// A gradient was requested for an empty set of samples.
    #[error("a minibatch is empty, but must have at least 1 sample")]
    NoSamples,
    /// The operating system could not start the threads.
    #[error(
        "{wanted} more threads cannot be started: {reason}; use fewer threads, or raise the limit of processes and \
         threads (`ulimit -u`, in a container pids.max)"
    )]
    Threads {
        /// Number of threads that were requested.
        wanted: usize,
        /// The operating system's error message.
        reason: String,
    },
    /// No library that computes gradients of recurrent policies is registered in this process.
    #[error("this program cannot train recurrent policies: use perturb-recurrent, which has libtorch")]
    NoRecurrentGradients,
    /// The library that computes gradients of recurrent policies returned an error.
    #[error("{library}: {reason}")]
    Library {
        /// The library's name.
        library: &'static str,
        /// The library's error message.
        reason: String,
    },
    /// Saved statistics of a normaliser are invalid.
    #[error("the statistics of {name} are invalid: {reason}")]
    Statistics {
        /// The quantity that is normalised: "observations" or "rewards".
        name: &'static str,
        /// A description of the fault.
        reason: String,
    },
    /// An observation or a reward is infinite or NaN.
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

/// Checks that an array called `name`, which has `got` elements, has `expected` elements.
///
/// # Errors
/// [`Error::Length`] if the numbers differ.
pub fn check_length(name: &'static str, got: usize, expected: usize) -> Result<()> {
    if got == expected { Ok(()) } else { Err(Error::Length { name, got, expected }) }
}
