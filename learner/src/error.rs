//! Errors of policies, rollouts and updates.

use perturb_settings::SettingError;

/// An error of a policy, a rollout or an update.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A setting is outside its range.
    #[error(transparent)]
    Setting(#[from] SettingError),
    /// Arrays of a policy have wrong lengths, or numbers are not finite.
    #[error(transparent)]
    Policy(#[from] perturb_policy::Error),
    /// A step was added to a full rollout, or a rollout was used before it was full.
    #[error("the rollout holds {got} of {expected} steps: {what}")]
    RolloutLength {
        /// Number of steps in the rollout.
        got: usize,
        /// Number of steps for which the rollout has room.
        expected: usize,
        /// The operation that failed.
        what: &'static str,
    },
    /// A signal asked the program to stop, and the rest of the update would have taken too long.
    #[error("stopped by signal {signal} during an update")]
    Stopped {
        /// The signal's number.
        signal: i32,
    },
    /// The described episode does not lie within the rollout.
    #[error(
        "an episode of {length} steps that ends before step {end} of environment {environment} is not in a rollout of \
         {n_steps} steps of {n_envs} environments; an episode has at least one step"
    )]
    Episode {
        /// The environment, from 0.
        environment: usize,
        /// The index of the step after the episode's last step.
        end: usize,
        /// The number of steps in the episode.
        length: usize,
        /// N, the number of environments.
        n_envs: usize,
        /// Number of steps in the rollout.
        n_steps: usize,
    },
}

/// A result with this module's [`Error`].
pub type Result<T> = std::result::Result<T, Error>;
