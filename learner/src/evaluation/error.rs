//! Errors of tests.

use perturb_records::testing::NotRecorded;
use perturb_settings::ValueError;

use crate::checkpoint::Changed;
use crate::client::ClientError;

/// The reason why a test failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TestError {
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The policy does not fit the environment, or computes numbers that are not finite.
    #[error(transparent)]
    Numbers(#[from] perturb_policy::Error),
    /// The environment does not have a parameter of the test set, a value is out of its bounds, or a threshold does not
    /// fit the environment's success rule.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The checkpoint's identifier cannot be computed.
    #[error("the checkpoint's id cannot be computed: {0}")]
    Unnamed(String),
    /// The server played other episodes than the requested ones.
    #[error(transparent)]
    NotRecorded(#[from] NotRecorded),
    /// The environment has changed since the policy was trained.
    #[error(transparent)]
    Changed(#[from] Changed),
    /// A signal asked the program to stop.
    #[error("stopped before all episodes were tested")]
    Stopped {
        /// The signal's number.
        signal: i32,
    },
}

impl TestError {
    /// Returns whether the test may succeed later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        matches!(self, Self::Client(error) if error.can_be_retried())
    }

    /// Returns the signal that stopped the test; `None` if another error ended it.
    pub fn signal(&self) -> Option<i32> {
        match self {
            Self::Stopped { signal } => Some(*signal),
            Self::Client(error) => error.signal(),
            _ => None,
        }
    }
}
