//! Testing: does a trained policy still work when the physics changes?

mod agent;
mod heatmap;
mod test;

pub use agent::Agent;
pub use heatmap::{HeatmapError, heatmap};
pub use test::{TestError, check_unchanged, environment_seed, open_options, play, test};
