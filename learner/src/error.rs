//! Errors of the numerical half of the learner.

use perturb_settings::SettingError;

/// A failure of a policy, a rollout or an update.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A setting is outside its range.
    #[error(transparent)]
    Setting(#[from] SettingError),
    /// A policy's arrays or numbers do not fit.
    #[error(transparent)]
    Policy(#[from] perturb_policy::Error),
    /// A rollout was pushed to when full, or used before it was full.
    #[error("the rollout holds {got} of {expected} steps: {what}")]
    RolloutLength {
        /// Steps that it holds.
        got: usize,
        /// Steps that fit.
        expected: usize,
        /// The operation that failed.
        what: &'static str,
    },
    /// The program was asked to end, and the update would have taken long.
    #[error("stopped by signal {signal} during an update")]
    Stopped {
        /// The signal.
        signal: i32,
    },
    /// An episode is not in a rollout.
    #[error(
        "an episode of {length} steps that ends before step {end} of environment {environment} is not in a rollout of \
         {n_steps} steps of {n_envs} environments; one has at least one step"
    )]
    Episode {
        /// The environment, from 0.
        environment: usize,
        /// The number of the step after the episode's last one.
        end: usize,
        /// The number of steps.
        length: usize,
        /// N, the number of environments.
        n_envs: usize,
        /// Steps that the rollout holds.
        n_steps: usize,
    },
}

/// A result with this module's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;
