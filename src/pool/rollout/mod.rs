//! Rollouts of policies, which the workers run without the session.

pub(in crate::pool) mod policy_runner;
pub(in crate::pool) mod task;
