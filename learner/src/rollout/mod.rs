//! Rollouts (T steps of N environments): their collection, storage and advantages.

mod advantage;
mod buffer;
mod collector;
mod decoded;

pub use advantage::{Estimates, EstimatorStep, Trajectories, explained_variance};
pub use buffer::{EpisodeSlice, RolloutBuffer};
pub use collector::{CollectError, Collector, CollectorState};
pub use decoded::DecodedRollout;
pub use perturb_policy::{Normalisers, RolloutStep};
