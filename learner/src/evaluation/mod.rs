//! Tests of trained policies: does a policy still work when the physics changes?

mod audit;
mod error;
mod heatmap;
mod test;
mod trials;

pub use audit::{Audit, AuditError, audit};
pub use error::TestError;
pub use heatmap::{HeatmapError, heatmap, heatmap_again};
pub use test::{TestOptions, Tester, open_options, test};
