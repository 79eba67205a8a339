//! Testing: does a trained policy still work when the physics changes?

mod agent;
mod audit;
mod heatmap;
mod test;

pub use agent::Agent;
pub use audit::{Audit, AuditError, audit};
pub use heatmap::{HeatmapError, heatmap, heatmap_again};
pub use test::{TestError, TestOptions, Tester, check_unchanged, environment_seed, open_options, test};
