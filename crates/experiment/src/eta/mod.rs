//! Estimates of the remaining time of trainings and experiments.
//!
//! [`TrainingProgress`] estimates the rest of one training. [`CellDurations`] has the durations of finished cells.
//! [`remaining_time`] combines both with measured speeds into the remaining time of an experiment.

mod durations;
mod progress;
mod remaining;

pub use durations::CellDurations;
pub use progress::TrainingProgress;
pub use remaining::RemainingTime;
pub(crate) use remaining::{UnfinishedCell, remaining_time};
