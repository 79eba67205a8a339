//! Errors of commands, with their exit status.

use std::io::ErrorKind;

use perturb_experiment::scheduler::RunError;
use perturb_experiment::scheduler::slurm::{OptionError, SlurmError};
use perturb_experiment::{ExportError, FolderError, PlanError, VerifyError};
use perturb_files::FileError;
use perturb_learner::checkpoint::CheckpointError;
use perturb_learner::client::ClientError;
use perturb_learner::evaluation::{AuditError, HeatmapError, TestError};
use perturb_learner::measure::MeasureError;
use perturb_learner::training::{RunDirectoryError, TrainError};
use perturb_protocol::names::UnknownEnvironment;
use perturb_protocol::spawn_failure;
use perturb_records::{ExternalEvaluationError, RecordsError, TableError};
use perturb_report::ReportError;
use perturb_report::plot::PlotError;
use perturb_serve::ServeError;
use perturb_settings::{ConfigError, ValueError};

use crate::video::VideoError;

pub(super) type Result<T, E = CommandError> = std::result::Result<T, E>;

/// The error of a failed command. Its message includes the messages of its causes.
#[derive(Debug, thiserror::Error)]
pub(super) enum CommandError {
    /// An argument is wrong.
    #[error("{0}")]
    Usage(String),
    #[error("{0}")]
    Failed(String),
    #[error("cannot {action}: {}", spawn_failure(source))]
    System { action: &'static str, source: std::io::Error },
    /// Standard output cannot be written.
    #[error("cannot write: {0}")]
    Output(#[from] std::io::Error),
    /// The test for a heatmap of an experiment has failed. `place` names the heatmap's policy.
    #[error("{place}: {source}")]
    Heatmaps { place: String, source: Box<CommandError> },
    #[error(transparent)]
    ExternalEvaluation(#[from] ExternalEvaluationError),
    #[error(transparent)]
    Audit(#[from] AuditError),
    #[error("{}", with_searched_folders(.0))]
    Checkpoint(#[from] CheckpointError),
    #[error("{}", with_task_hint(.0))]
    Client(#[from] ClientError),
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Directory(#[from] RunDirectoryError),
    #[error(transparent)]
    Export(#[from] ExportError),
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
    Report(#[from] ReportError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Serve(#[from] ServeError),
    #[error(transparent)]
    Slurm(#[from] SlurmError),
    #[error(transparent)]
    Table(#[from] TableError),
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
    /// Returns the signal that ended the command, if one did.
    pub(super) fn signal(&self) -> Option<i32> {
        match self {
            Self::Heatmaps { source, .. } => source.signal(),
            Self::Client(error) => error.signal(),
            Self::Test(error)
            | Self::Audit(AuditError::Test(error))
            | Self::Measure(MeasureError::Test(error))
            | Self::Heatmap(HeatmapError::Test(error))
            | Self::Video(VideoError::Test(error)) => error.signal(),
            Self::Measure(MeasureError::Stopped { signal }) => Some(*signal),
            Self::Train(error) => error.signal(),
            _ => None,
        }
    }

    /// Tells whether an argument or file is missing or wrong, so that the command did not begin.
    pub(super) fn is_usage(&self) -> bool {
        match self {
            Self::Usage(_)
            | Self::Config(_)
            | Self::Option(_)
            | Self::Plan(_)
            | Self::Report(
                ReportError::Plan(_)
                | ReportError::Value(_)
                | ReportError::Neither { .. }
                | ReportError::NoStudy { .. }
                | ReportError::Table(TableError::Missing { .. } | TableError::Damaged { .. })
                | ReportError::Experiments { .. },
            )
            | Self::Value(_)
            | Self::Serve(ServeError::NoFolder { .. } | ServeError::Address { .. })
            | Self::Checkpoint(CheckpointError::Missing { .. } | CheckpointError::Several { .. })
            | Self::Records(RecordsError::Missing { .. } | RecordsError::Other { .. })
            | Self::Audit(AuditError::Policy { .. })
            | Self::Folder(FolderError::NoPlan { .. } | FolderError::OtherModel { .. })
            | Self::Slurm(SlurmError::NotInstalled { .. })
            | Self::Table(TableError::Missing { .. } | TableError::Damaged { .. })
            | Self::Video(VideoError::Extension { .. } | VideoError::NoFfmpeg { .. })
            | Self::Test(TestError::Value(_))
            | Self::Heatmap(HeatmapError::Parameter { .. } | HeatmapError::Fixed { .. }) => true,
            Self::Client(error) => is_wrong_server(error),
            Self::Directory(error) | Self::Train(TrainError::Directory(error)) => is_wrong_directory(error),
            Self::File(error)
            | Self::Serve(ServeError::File(error))
            | Self::Video(VideoError::File(error))
            | Self::Records(RecordsError::File(error))
            | Self::Train(TrainError::File(error)) => is_wrong_file(error),
            _ => false,
        }
    }

    /// Tells whether the program that reads the output has ended early, e.g. `head` in `perturb envs | head`.
    pub(super) fn is_closed_pipe(&self) -> bool {
        match self {
            Self::Output(error) | Self::File(FileError { source: error, .. }) => error.kind() == ErrorKind::BrokenPipe,
            _ => false,
        }
    }
}

/// Returns the message of a checkpoint's error. Adds the searched folders if there is no checkpoint, and suggests a
/// similar name if there is exactly one.
fn with_searched_folders(error: &CheckpointError) -> String {
    match error {
        CheckpointError::Missing { .. } => {
            format!("{error} of the working directory, or in the folder that PERTURB_RESULTS names")
        }
        CheckpointError::Several { name, folder, names } if names.len() == 1 => {
            format!("there is no policy `{name}` in {} (did you mean `{}`?)", folder.display(), names[0])
        }
        _ => error.to_string(),
    }
}

/// Returns the message of a client's error. Adds a hint about --task if the environment is unknown.
fn with_task_hint(error: &ClientError) -> String {
    match error {
        ClientError::NoEnvironment(UnknownEnvironment::Name { .. }) => {
            format!("{error}; an environment of a task folder needs --task DIR, of this command or of the server")
        }
        _ => error.to_string(),
    }
}

/// Makes the error of a failed system call. `action` completes the sentence "cannot …".
pub(super) fn system(action: &'static str) -> impl FnOnce(std::io::Error) -> CommandError {
    move |source| CommandError::System { action, source }
}

/// Tells whether the error is due to a wrong argument, such as --server or an environment's name.
fn is_wrong_server(error: &ClientError) -> bool {
    matches!(
        error,
        ClientError::Connect { .. }
            | ClientError::NotPerturb { .. }
            | ClientError::Unsafe { .. }
            | ClientError::NoneConnects { .. }
            | ClientError::NoServerProgram { .. }
            | ClientError::NoEnvironment(_)
            | ClientError::NoParameters { .. }
            | ClientError::NoContexts { .. }
            | ClientError::Disagreement { .. }
            | ClientError::Models { .. }
            | ClientError::Tasks { .. }
    )
}

/// Tells whether the error is due to a wrong path of a run's directory.
fn is_wrong_directory(error: &RunDirectoryError) -> bool {
    match error {
        RunDirectoryError::File(error) => is_wrong_file(error),
        RunDirectoryError::Locked { .. }
        | RunDirectoryError::Checkpoint(CheckpointError::Damaged { .. } | CheckpointError::File(_)) => false,
        _ => true,
    }
}

/// Tells whether the error is due to a wrong path of a file, as opposed to a full or broken disk.
fn is_wrong_file(error: &FileError) -> bool {
    matches!(
        error.source.kind(),
        ErrorKind::NotFound
            | ErrorKind::PermissionDenied
            | ErrorKind::AlreadyExists
            | ErrorKind::IsADirectory
            | ErrorKind::NotADirectory
            | ErrorKind::ReadOnlyFilesystem
            | ErrorKind::InvalidFilename
            | ErrorKind::InvalidInput // a pipe or a device
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_policy_is_reported_with_the_searched_folders() {
        let missing = CommandError::from(CheckpointError::Missing { path: "nothing".into() }).to_string();
        let folders = "in results/ of the working directory, or in the folder that PERTURB_RESULTS names";
        assert!(missing.starts_with("nothing holds no checkpoint: ") && missing.ends_with(folders), "{missing}");
        let several = |names: &[&str]| {
            let names = names.iter().map(ToString::to_string).collect();
            CommandError::from(CheckpointError::Several { name: "s77".into(), folder: "results".into(), names })
        };
        assert_eq!(
            several(&["a/cells/s7"]).to_string(),
            "there is no policy `s77` in results (did you mean `a/cells/s7`?)"
        );
        assert!(several(&["a", "b"]).to_string().contains("could be any of these policies"));
    }
}
