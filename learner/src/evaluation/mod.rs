//! Testing: does a trained policy still work when the physics changes?

mod agent;
pub mod paper;
mod protocol;
mod statistics;
mod test;

pub(crate) use agent::Agent;
pub use paper::Method;
pub use protocol::{Metric, Scenario, Version};
pub use statistics::{geometric_mean, mean, wilson};
pub use test::{TestError, TestResult, environment_seed, test};
pub(crate) use test::{check_unchanged, open_options, play};
