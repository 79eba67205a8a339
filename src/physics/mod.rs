//! The physical parameters of the environments: what can be changed, within which bounds, and how it is drawn.

mod distribution;
mod parameter;
mod table;

pub use distribution::{Distribution, Interval};
pub use parameter::{Parameter, Version, check_bounds, resolve};
pub use table::*;
