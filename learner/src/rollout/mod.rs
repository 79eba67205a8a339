//! Rollouts: T steps of N environments, how they are collected, and the advantages that follow from them.

mod advantage;
mod buffer;
mod collector;
mod decoded;

pub use advantage::{Estimates, EstimatorStep, Trajectories, explained_variance};
pub use buffer::{EpisodeSlice, Rollout};
pub use collector::{CollectError, Collector, CollectorState};
pub use decoded::DecodedRollout;
pub use perturb_policy::{Normalisers, RolloutStep};
