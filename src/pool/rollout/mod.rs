//! Rollouts of policies on the workers.

pub(in crate::pool) mod policy_runner;
pub(in crate::pool) mod task;
