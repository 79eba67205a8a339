//! Policies that play on the workers.

pub(in crate::pool) mod play;
pub(in crate::pool) mod round;
