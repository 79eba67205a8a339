//! Rollouts: what was seen in T steps of N environments, and what follows for the advantages.

mod advantage;
mod buffer;
mod collector;
mod decoded;

pub use advantage::{Estimates, EstimatorStep, Trajectories, explained_variance};
pub use buffer::{Rollout, Span};
pub use collector::{CollectError, Collector, CollectorState};
pub use decoded::DecodedRollout;
pub use perturb_policy::{Normalisers, RolloutStep};
