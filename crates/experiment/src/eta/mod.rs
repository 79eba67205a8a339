//! Estimates of the remaining time of trainings and experiments.
//!
//! [`TrainingProgress`] is the progress of one training, [`CellDurations`] has the durations of finished cells, and
//! [`remaining_time`] combines both with measurements to the remaining time of an experiment.

mod durations;
mod progress;
mod remaining;

pub use durations::CellDurations;
pub use progress::TrainingProgress;
pub use remaining::RemainingTime;
pub(crate) use remaining::{UnfinishedCell, remaining_time};
