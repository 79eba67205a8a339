//! Rollouts: what was seen in T steps of N environments, and what follows for the advantages.

mod advantage;
mod buffer;
mod collector;

pub use advantage::{Estimates, Trajectories, gae, n_step_returns};
pub use buffer::{Rollout, RolloutStep};
pub use collector::{CollectError, Collector, CollectorState, Normalisers, Times};
