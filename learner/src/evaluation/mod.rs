//! Testing: does a trained policy still work when the physics changes?

mod audit;
mod heatmap;
mod test;
mod trials;

pub use audit::{Audit, AuditError, audit};
pub use heatmap::{HeatmapError, heatmap, heatmap_again};
pub use test::{TestError, TestOptions, Tester, open_options, test};
