//! Rollouts: what was seen in T steps of N environments, and what follows for the advantages.

mod advantage;
mod buffer;
mod collector;
mod normalisers;

pub use advantage::{Estimates, Trajectories, explained_variance, gae, n_step_returns};
pub use buffer::{Rollout, RolloutStep, Span};
pub use collector::{CollectError, Collector, CollectorState, Times};
pub use normalisers::Normalisers;
