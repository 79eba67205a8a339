//! Why a command fails, and with which exit status.

use std::io::ErrorKind;

use perturb_learner::checkpoint::CheckpointError;
use perturb_learner::client::ClientError;
use perturb_learner::evaluation::{AuditError, HeatmapError, TestError};
use perturb_learner::measure::MeasureError;
use perturb_learner::training::{RunDirectoryError, TrainError};
use perturb_study::files::FileError;
use perturb_study::plot::PlotError;
use perturb_study::records::RecordsError;
use perturb_study::scheduler::RunError;
use perturb_study::scheduler::slurm::{OptionError, SlurmError};
use perturb_study::settings::ConfigError;
use perturb_study::{FolderError, PlanError, ValueError, VerifyError};

use crate::video::VideoError;

pub(super) type Result<T, E = CommandError> = std::result::Result<T, E>;

/// Why a command failed. Its sentence holds those of its causes.
#[derive(Debug, thiserror::Error)]
pub(super) enum CommandError {
    /// A mistake of the person who typed the command.
    #[error("{0}")]
    Usage(String),
    #[error("{0}")]
    Failed(String),
    #[error("cannot {action}: {source}")]
    System { action: &'static str, source: std::io::Error },
    /// Standard output takes no more.
    #[error("cannot write: {0}")]
    Output(#[from] std::io::Error),
    /// One of several heatmaps.
    #[error("{place}: {source}")]
    Place { place: String, source: Box<CommandError> },
    #[error(transparent)]
    Audit(#[from] AuditError),
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    #[error(transparent)]
    Client(#[from] ClientError),
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Directory(#[from] RunDirectoryError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error(transparent)]
    Heatmap(#[from] HeatmapError),
    #[error(transparent)]
    Measure(#[from] MeasureError),
    #[error(transparent)]
    Option(#[from] OptionError),
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(transparent)]
    Plot(#[from] PlotError),
    #[error(transparent)]
    Records(#[from] RecordsError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Slurm(#[from] SlurmError),
    #[error(transparent)]
    Test(#[from] TestError),
    #[error(transparent)]
    Train(#[from] TrainError),
    #[error(transparent)]
    Value(#[from] ValueError),
    #[error(transparent)]
    Verify(#[from] VerifyError),
    #[error(transparent)]
    Video(#[from] VideoError),
}

impl CommandError {
    /// The signal that ended the command, if one did.
    pub(super) fn signal(&self) -> Option<i32> {
        match self {
            Self::Place { source, .. } => source.signal(),
            Self::Test(error)
            | Self::Audit(AuditError::Test(error))
            | Self::Heatmap(HeatmapError::Test(error))
            | Self::Video(VideoError::Test(error)) => error.signal(),
            _ => None,
        }
    }

    /// Whether the command itself was wrong.
    pub(super) fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::Usage(_)
                | Self::Config(_)
                | Self::Option(_)
                | Self::Plan(_)
                | Self::Value(_)
                | Self::Video(VideoError::Extension { .. })
        )
    }

    /// Whether nobody reads any further, which is how `perturb envs | head` ends.
    pub(super) fn is_closed_pipe(&self) -> bool {
        match self {
            Self::Output(error) | Self::File(FileError { source: error, .. }) => error.kind() == ErrorKind::BrokenPipe,
            _ => false,
        }
    }
}

/// Says what the operating system refused.
pub(super) fn system(action: &'static str) -> impl FnOnce(std::io::Error) -> CommandError {
    move |source| CommandError::System { action, source }
}
