//! What Hopper and HalfCheetah share: Roboschool's task (Brockman et al., 2016; Schulman et al., 2017) on MuJoCo 2.2.2.
//!
//! [`Walker`] is the task; the robots' folders say what differs. The models are in `models/`, with the source of each
//! number.

pub(super) mod channels;
pub(super) mod colours;
mod model_edit;
mod walker;

pub use walker::Walker;
pub(super) use walker::{Posture, Task};

/// Follows a robot's own elements in its MJCF. The floor of the physics ends 40 m from the start, as a picture; the
/// ground here does not. The line is where the task is done.
pub(super) const SCENERY: &str = include_str!("../../../models/scenery.xml");
