//! Rollouts: what was seen in T steps of N environments, and what follows for the advantages.

mod advantage;
mod buffer;

pub use advantage::{Estimates, Trajectories, gae, n_step_returns};
pub use buffer::{Rollout, RolloutStep};
