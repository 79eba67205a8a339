//! Errors of tests.

use perturb_records::testing::NotRecorded;
use perturb_settings::ValueError;

use crate::checkpoint::Changed;
use crate::client::ClientError;

/// Why a checkpoint could not be tested.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TestError {
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The policy gives numbers that are not finite, or does not fit.
    #[error(transparent)]
    Numbers(#[from] perturb_policy::Error),
    /// The environment does not have the set's parameters, or refuses their values; or the threshold does not fit the
    /// environment's success rule.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The checkpoint cannot be named.
    #[error("the checkpoint's id cannot be computed: {0}")]
    Unnamed(String),
    /// The server played other episodes than it was asked for.
    #[error(transparent)]
    NotRecorded(#[from] NotRecorded),
    /// The environment has changed since the policy was trained.
    #[error(transparent)]
    Changed(#[from] Changed),
    /// The program was asked to end.
    #[error("stopped before all episodes were tested")]
    Stopped {
        /// The signal.
        signal: i32,
    },
}

impl TestError {
    /// Whether the test may succeed later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        matches!(self, Self::Client(error) if error.can_be_retried())
    }

    /// The signal that ended the test, if one did.
    pub fn signal(&self) -> Option<i32> {
        match self {
            Self::Stopped { signal } => Some(*signal),
            Self::Client(error) => error.signal(),
            _ => None,
        }
    }
}
