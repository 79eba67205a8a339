//! Tests of trained policies, in particular with changed physics.

mod audit;
mod error;
mod heatmap;
mod test;
mod trials;

pub use audit::{Audit, AuditError, audit};
pub use error::TestError;
pub use heatmap::{HeatmapError, heatmap, heatmap_again};
pub use test::{TestOptions, Tester, open_options, test};
