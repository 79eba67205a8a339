//! What can go wrong in the numerical half of the learner.

use perturb_study::settings::SettingError;

/// A failure of a policy, a rollout or an update.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A setting is outside its range.
    #[error(transparent)]
    Setting(#[from] SettingError),
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
        /// What became infinite or NaN, e.g. "the loss".
        what: &'static str,
        /// Its value: NaN, inf or -inf.
        value: f64,
        /// Index of the gradient step, from 0.
        update: u64,
    },
    /// A policy gave a log-probability or a value that is infinite or NaN.
    #[error(
        "the policy's output in environment {environment} is not finite; its weights or observation hold NaN or inf"
    )]
    PolicyOutput {
        /// Which of the N environments.
        environment: usize,
    },
    /// An input that must be finite is not.
    #[error("{name} hold {value}; the environment's numbers must be finite")]
    Input {
        /// The array, with its axes.
        name: &'static str,
        /// The first such element.
        value: f32,
    },
    /// A rollout was pushed to when full, or used before it was full.
    #[error("the rollout holds {got} of {expected} steps: {what}")]
    RolloutLength {
        /// Steps that it holds.
        got: usize,
        /// Steps that fit.
        expected: usize,
        /// What was attempted.
        what: &'static str,
    },
    /// An episode is not in a rollout.
    #[error(
        "an episode of {length} steps that ends before step {end} of environment {environment} is not in a rollout of \
         {n_steps} steps of {n_envs} environments; one has at least one step"
    )]
    Episode {
        /// Its environment, from 0.
        environment: usize,
        /// The step after its last.
        end: usize,
        /// Its number of steps.
        length: usize,
        /// N.
        n_envs: usize,
        /// Steps that the rollout holds.
        n_steps: usize,
    },
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}

/// A result with this module's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// `Ok` if a slice has the expected length; otherwise an [`Error::Length`].
pub(crate) fn check_length(name: &'static str, got: usize, expected: usize) -> Result<()> {
    if got == expected { Ok(()) } else { Err(Error::Length { name, got, expected }) }
}
