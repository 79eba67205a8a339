//! Errors of policies on libtorch.

use perturb_policy::Error as PolicyError;

/// A failure of a policy on libtorch.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A policy's arrays have the wrong length.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// libtorch reported an error.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}

/// A result with this module's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

impl From<Error> for PolicyError {
    fn from(error: Error) -> Self {
        match error {
            Error::Policy(error) => error,
            Error::Torch(error) => PolicyError::Library { library: "libtorch", reason: error.to_string() },
        }
    }
}
