//! The input and the result of a training.

use perturb_settings::TrainConfig;

use super::{Result, RunDirectory};
use crate::checkpoint::{Checkpoint, ResumeState};
use crate::logging::Progress;

/// The result of a training.
#[derive(Debug)]
pub struct TrainOutcome {
    /// The last checkpoint, as written to the disk.
    pub checkpoint: Checkpoint,
    /// Statistics of the last iteration.
    pub progress: Progress,
    /// The signal that stopped the training; `None` if it ran to its end.
    pub signal: Option<i32>,
}

/// A request to start or resume a training.
#[derive(Debug)]
pub struct TrainRequest<'a> {
    /// The directory for logs and checkpoints.
    pub directory: &'a RunDirectory,
    /// The start of the training: initial weights or a checkpoint.
    pub start: Start,
    /// Numbers of episodes, ascending, after which the intermediate policy is saved for later tests, see
    /// [`RunDirectory::mark`].
    pub marks: &'a [u64],
}

/// The start of a training: initial weights or a checkpoint.
#[derive(Clone, Debug)]
pub enum Start {
    /// The training starts from initial weights, with this configuration.
    Fresh(Box<TrainConfig>),
    /// The training continues from this checkpoint.
    Checkpoint(Box<(Checkpoint, ResumeState)>),
}

impl Start {
    /// Returns the configuration of the training.
    pub(super) fn config(&self) -> &TrainConfig {
        match self {
            Self::Fresh(config) => config,
            Self::Checkpoint(saved) => &saved.0.state.config,
        }
    }

    /// Returns the number of steps before the start: 0 without a checkpoint.
    pub(super) fn timesteps(&self) -> u64 {
        match self {
            Self::Fresh(_) => 0,
            Self::Checkpoint(saved) => saved.0.state.counters.timesteps,
        }
    }

    /// Returns where an interrupted training of `config` in `directory` resumes: at its last checkpoint, or at initial
    /// weights if there is none.
    pub(super) fn resume_point(directory: &RunDirectory, config: &TrainConfig) -> Result<Self> {
        Ok(match directory.last_checkpoint()? {
            Some((mut checkpoint, state)) => {
                checkpoint.state.config = config.clone(); // the checkpoint may still have an older, smaller budget
                Self::Checkpoint(Box::new((checkpoint, state)))
            }
            None => Self::Fresh(Box::new(config.clone())),
        })
    }
}
