//! Errors of trainings.

use std::path::PathBuf;

use perturb_checkpoint::task_remedy;
use perturb_files::FileError;
use perturb_records::Difference;

use super::RunDirectoryError;
use crate::checkpoint::CheckpointError;
use crate::client::ClientError;
use crate::error::Error;
use crate::logging::LogError;
use crate::rollout::CollectError;

/// The reason why a training cannot start, continue or be saved.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// The training cannot use its directory.
    #[error(transparent)]
    Directory(#[from] RunDirectoryError),
    /// A server or the connection to it failed.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// A number is not finite, or an array has the wrong size.
    #[error(transparent)]
    Numbers(#[from] Error),
    /// The checkpoint cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The interval of an action is empty or infinite, so a random policy cannot draw from it.
    #[error(
        "a random policy draws actions from their bounds, but `{name}` is in [{low}, {high}]; train another algorithm"
    )]
    Unbounded {
        /// The name of the action's entry.
        name: String,
        /// The lower bound.
        low: f64,
        /// The upper bound.
        high: f64,
    },
    /// There is no heuristic policy for the environment.
    #[error("there is no heuristic policy for {environment}; CartPole, MountainCar, Acrobot and Pendulum have one")]
    NoHeuristic {
        /// The name of the environment.
        environment: String,
    },
    /// A log cannot be continued.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The operating system could not read or write a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The served environment has no action space.
    #[error(
        "the server does not describe the environment's actions: do the server and this program have the same version?"
    )]
    NoActions,
    /// An episode ran with other parameters than requested.
    #[error(
        "an episode of environment {environment_index}, number {episode_index}: {difference}; this is a server bug, please \
         report it"
    )]
    NotApplied {
        /// The index of the environment.
        environment_index: u32,
        /// The index of the episode in its environment.
        episode_index: u64,
        /// The largest difference between requested and applied parameters.
        difference: Difference,
    },
    /// The environment has changed since the start of the training.
    #[error(
        "the run was trained in {environment} with {what} {trained}, but the server has {served}; {}resume with the \
         version of perturb-server that it began with, or train again",
        task_remedy(what)
    )]
    Changed {
        /// The environment's name.
        environment: String,
        /// The name of the property that differs, e.g. "revision".
        what: &'static str,
        /// The property's value in training.
        trained: String,
        /// The property's value on the server.
        served: String,
    },
    /// A part of a checkpoint cannot be restored.
    #[error("cannot restore the {what}: {source}")]
    Restore {
        /// The name of the part.
        what: &'static str,
        /// The underlying error.
        source: Box<TrainError>,
    },
    /// A signal stopped the program while it waited for a lost server.
    #[error("stopped by signal {signal}, waiting for a server: {source}")]
    Stopped {
        /// The signal's number.
        signal: i32,
        /// The error of the lost server.
        source: Box<TrainError>,
    },
    /// A signal stopped the program during a long update.
    #[error("stopped by signal {signal} during an update, which was interrupted")]
    UpdateStopped {
        /// The signal's number.
        signal: i32,
    },
    /// A training failed after it had started.
    #[error("{source}; {}", what_is_left(last.as_ref(), source))]
    Failed {
        /// The last checkpoint; `None` if there is none.
        last: Option<LastCheckpoint>,
        /// The underlying error.
        source: Box<TrainError>,
    },
}

/// The last checkpoint of a failed training.
#[derive(Debug)]
pub struct LastCheckpoint {
    /// Number of training episodes at the checkpoint.
    pub episodes: u64,
    /// The directory of the run.
    pub run: PathBuf,
}

impl TrainError {
    /// Returns the error of a server; `None` if no server failed.
    pub fn of_server(&self) -> Option<&ClientError> {
        match self {
            Self::Client(error) => Some(error),
            Self::Restore { source, .. } | Self::Failed { source, .. } | Self::Stopped { source, .. } => {
                source.of_server()
            }
            _ => None,
        }
    }

    /// Returns the signal that stopped the training; `None` if another error ended it.
    pub fn signal(&self) -> Option<i32> {
        match self {
            Self::Stopped { signal, .. } | Self::UpdateStopped { signal } => Some(*signal),
            Self::Client(error) => error.signal(),
            Self::Restore { source, .. } | Self::Failed { source, .. } => source.signal(),
            _ => None,
        }
    }

    /// Returns whether a server had no room for the environments.
    pub fn is_server_full(&self) -> bool {
        let full = tonic::Code::ResourceExhausted;
        matches!(self.of_server(), Some(ClientError::Refused { code, .. }) if *code == full)
    }

    /// Returns whether the file system is at fault, see [`FileError::is_fault`].
    pub fn is_file_fault(&self) -> bool {
        match self {
            Self::File(error)
            | Self::Log(LogError::File(error))
            | Self::Checkpoint(CheckpointError::File(error))
            | Self::Directory(RunDirectoryError::File(error))
            | Self::Directory(RunDirectoryError::Checkpoint(CheckpointError::File(error))) => error.is_fault(),
            Self::Restore { source, .. } | Self::Failed { source, .. } => source.is_file_fault(),
            _ => false,
        }
    }

    /// Returns whether the training would fail in the same way if it were resumed from its last checkpoint, for example
    /// because numbers are not finite.
    pub fn requires_restart(&self) -> bool {
        match self {
            Self::Numbers(_) | Self::Log(LogError::Changed { .. }) => true,
            Self::Restore { source, .. } => !source.can_be_retried() && !source.is_file_fault(),
            Self::Failed { source, .. } => source.requires_restart(),
            _ => false,
        }
    }

    /// Returns whether the training may succeed later or with another server, see [`ClientError::can_be_retried`].
    pub fn can_be_retried(&self) -> bool {
        self.of_server().is_some_and(ClientError::can_be_retried)
    }
}

impl From<CollectError> for TrainError {
    fn from(error: CollectError) -> Self {
        match error {
            CollectError::Client(error) => Self::Client(error),
            CollectError::Numbers(error) => Self::Numbers(error),
        }
    }
}

/// Describes the last checkpoint of a failed training, for the error message.
fn what_is_left(last: Option<&LastCheckpoint>, error: &TrainError) -> String {
    let Some(LastCheckpoint { episodes, run }) = last else { return "there was no checkpoint yet".into() };
    let advice = if let TrainError::Numbers(_) = error { ": resumed, it would fail with the same numbers" } else { "" };
    format!("the checkpoint after {episodes} episodes is kept in {}{advice}", run.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_server_can_be_retried() {
        let address: crate::client::Address = "unix:/x".parse().unwrap();
        let lost = || {
            let request = "a step";
            let code = tonic::Code::Unavailable;
            let reason = "gone".into();
            ClientError::Lost { address: address.clone(), request, code, reason }
        };
        let refused = |code| {
            let message = "no".into();
            CollectError::Client(ClientError::Refused { address: address.clone(), request: "open", code, message })
        };
        let failed = |source: TrainError| TrainError::Failed { last: None, source: Box::new(source) };
        assert!(TrainError::from(lost()).can_be_retried());
        assert!(failed(lost().into()).can_be_retried());
        assert!(failed(refused(tonic::Code::ResourceExhausted).into()).can_be_retried(), "the server is full");
        assert!(!failed(refused(tonic::Code::NotFound).into()).can_be_retried());
        assert!(!TrainError::NoActions.can_be_retried());
    }

    #[test]
    fn failure_names_the_last_checkpoint() {
        let shown = |saved: bool, source: TrainError| {
            let last = saved.then(|| LastCheckpoint { episodes: 7, run: "runs/a".into() });
            TrainError::Failed { last, source: Box::new(source) }.to_string()
        };
        let numbers = || TrainError::Numbers(perturb_policy::Error::PolicyOutput { environment: 0 }.into());
        assert!(shown(false, numbers()).ends_with("; there was no checkpoint yet"));
        let kept = "; the checkpoint after 7 episodes is kept in runs/a";
        assert!(shown(true, numbers()).ends_with(&format!("{kept}: resumed, it would fail with the same numbers")));
        let other = shown(true, TrainError::NoActions);
        assert!(other.starts_with("the server does not") && other.ends_with(kept), "{other}");
    }
}
