//! Testing: does a trained policy still work when the physics changes?

pub mod paper;
mod protocol;
mod statistics;
mod test;

pub use protocol::{Metrics, Rates, Scenario, Version};
pub use statistics::{geometric_mean, mean, wilson};
pub use test::{TestError, TestResult, environment_seed, test};
pub(crate) use test::{check_unchanged, play};
