//! Why a training cannot begin, go on, or be kept.

use std::path::PathBuf;

use perturb_files::FileError;
use perturb_records::Difference;

use super::RunDirectoryError;
use crate::checkpoint::CheckpointError;
use crate::client::ClientError;
use crate::error::Error;
use crate::logging::LogError;
use crate::rollout::CollectError;

/// Why a training cannot begin, go on, or be kept.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// The directory cannot be trained in.
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
    /// The box of the action space has no volume, or an infinite one.
    #[error("a random policy draws actions from their bounds, but `{name}` is in [{low}, {high}]: train another")]
    Unbounded {
        /// The action's entry.
        name: String,
        /// Its lower bound.
        low: f64,
        /// Its upper bound.
        high: f64,
    },
    /// A log cannot be gone on with.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The operating system refused a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// The served environment has no action space.
    #[error("the server does not say what actions the environment takes: are both of one version?")]
    NoActions,
    /// An episode did not run with the parameters that it was to run with.
    #[error("an episode of environment {environment_index}, number {episode_index}: {difference}; mend the server")]
    NotApplied {
        /// The environment's index.
        environment_index: u32,
        /// The episode's number in it.
        episode_index: u64,
        /// The largest difference.
        difference: Difference,
    },
    /// The environment is no longer what the run began in.
    #[error(
        "the run was trained in {environment} with {what} {trained}, the server's has {served}; resume with the version \
         of perturb-server that it began with, or train again"
    )]
    Changed {
        /// The environment.
        environment: String,
        /// What differs.
        what: &'static str,
        /// In training.
        trained: String,
        /// On the server.
        served: String,
    },
    /// What a checkpoint holds does not fit.
    #[error("cannot bring the {what} back: {source}")]
    Restore {
        /// What should go on where it was.
        what: &'static str,
        /// Why it cannot.
        source: Box<TrainError>,
    },
    /// The program was asked to end while a lost server was waited for.
    #[error("stopped by signal {signal}, waiting for a server: {source}")]
    Stopped {
        /// The signal.
        signal: i32,
        /// What was lost.
        source: Box<TrainError>,
    },
    /// A training that had begun ended.
    #[error("{source}; {}", what_is_left(last.as_ref(), source))]
    Failed {
        /// The last checkpoint, if there is one.
        last: Option<LastCheckpoint>,
        /// Why.
        source: Box<TrainError>,
    },
}

/// What a failed training leaves.
#[derive(Debug)]
pub struct LastCheckpoint {
    /// Episodes that it was trained for.
    pub episodes: u64,
    /// The directory of the run.
    pub run: PathBuf,
}

impl TrainError {
    /// What a server failed with, if that is what failed.
    pub fn of_server(&self) -> Option<&ClientError> {
        match self {
            Self::Client(error) => Some(error),
            Self::Restore { source, .. } | Self::Failed { source, .. } | Self::Stopped { source, .. } => {
                source.of_server()
            }
            _ => None,
        }
    }

    /// Whether a server had no room for the environments.
    pub fn is_for_want_of_room(&self) -> bool {
        let full = tonic::Code::ResourceExhausted;
        matches!(self.of_server(), Some(ClientError::Refused { code, .. }) if *code == full)
    }

    /// Whether the machine is at fault that has the files, see [`FileError::is_fault`].
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

    /// Whether the training would come to the same from its last checkpoint: to numbers that are not finite, for instance.
    pub fn must_begin_anew(&self) -> bool {
        match self {
            Self::Numbers(_) | Self::Log(LogError::Changed { .. }) => true,
            Self::Restore { source, .. } => !source.can_be_retried() && !source.is_file_fault(),
            Self::Failed { source, .. } => source.must_begin_anew(),
            _ => false,
        }
    }

    /// Whether the same may go well later or with another server, see [`ClientError::can_be_retried`].
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

fn what_is_left(last: Option<&LastCheckpoint>, error: &TrainError) -> String {
    let Some(LastCheckpoint { episodes, run }) = last else { return "there was no checkpoint yet".into() };
    let again = if let TrainError::Numbers(_) = error { ": resumed, it would come to the same numbers" } else { "" };
    format!("the checkpoint after {episodes} episodes is kept in {}{again}", run.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lost_server_is_told_from_a_failure() {
        let address: crate::client::Address = "unix:/x".parse().unwrap();
        let lost = || {
            let (request, code, reason) = ("a step", tonic::Code::Unavailable, "gone".into());
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
    fn a_failure_says_what_is_left_and_what_to_do() {
        let shown = |saved: bool, source: TrainError| {
            let last = saved.then(|| LastCheckpoint { episodes: 7, run: "runs/a".into() });
            TrainError::Failed { last, source: Box::new(source) }.to_string()
        };
        let numbers = || TrainError::Numbers(perturb_policy::Error::PolicyOutput { environment: 0 }.into());
        assert!(shown(false, numbers()).ends_with("; there was no checkpoint yet"));
        let kept = "; the checkpoint after 7 episodes is kept in runs/a";
        assert!(shown(true, numbers()).ends_with(&format!("{kept}: resumed, it would come to the same numbers")));
        let other = shown(true, TrainError::NoActions);
        assert!(other.starts_with("the server does not") && other.ends_with(kept), "{other}");
    }
}
