//! The input and the result of a training.

use perturb_settings::TrainConfig;

use super::{Result, RunDirectory};
use crate::checkpoint::{Checkpoint, ResumeState};
use crate::logging::Progress;

/// Result of a training.
#[derive(Debug)]
pub struct TrainOutcome {
    /// The last checkpoint, as written.
    pub checkpoint: Checkpoint,
    /// Figures of the last iteration.
    pub progress: Progress,
    /// The signal that ended the training before its budget; `None` if it ran to its end.
    pub signal: Option<i32>,
}

/// A training to begin or to resume.
#[derive(Debug)]
pub struct TrainRequest<'a> {
    /// The directory for logs and checkpoints.
    pub directory: &'a RunDirectory,
    /// The point at which the training starts.
    pub start: Start,
    /// Numbers of episodes, ascending, after which the policy is kept for an intermediate evaluation, see
    /// [`RunDirectory::mark`].
    pub marks: &'a [u64],
}

/// The point at which a training starts.
#[derive(Clone, Debug)]
pub enum Start {
    /// Initial weights.
    Fresh(Box<TrainConfig>),
    /// The last checkpoint.
    Checkpoint(Box<(Checkpoint, ResumeState)>),
}

impl Start {
    /// The configuration to train with.
    pub(super) fn config(&self) -> &TrainConfig {
        match self {
            Self::Fresh(config) => config,
            Self::Checkpoint(saved) => &saved.0.state.config,
        }
    }

    /// Steps that were trained before.
    pub(super) fn timesteps(&self) -> u64 {
        match self {
            Self::Fresh(_) => 0,
            Self::Checkpoint(saved) => saved.0.state.counters.timesteps,
        }
    }

    /// The point at which an interrupted training of `config` in `directory` is resumed.
    pub(super) fn resume_point(directory: &RunDirectory, config: &TrainConfig) -> Result<Self> {
        Ok(match directory.last_checkpoint()? {
            Some((mut checkpoint, state)) => {
                checkpoint.state.config = config.clone(); // a larger budget may not have been saved yet
                Self::Checkpoint(Box::new((checkpoint, state)))
            }
            None => Self::Fresh(Box::new(config.clone())),
        })
    }
}
