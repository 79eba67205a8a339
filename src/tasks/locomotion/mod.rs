//! The task that Hopper and HalfCheetah share: Roboschool's running task (Brockman et al., 2016; Schulman et al.,
//! 2017), simulated by MuJoCo 2.2.2.
//!
//! [`Walker`] implements the task. All environments of the same robot that one thread runs share a simulation
//! (`tasks/shared.rs`). Each robot's module has the robot's specification. The models are in `models/`, with the source
//! of each number.

pub(super) mod channels;
pub(super) mod colours;
mod model_edit;
mod pristine;
#[cfg(test)]
mod tests;
mod walker;

pub use walker::Walker;

use crate::{env::EnvironmentSpec, scene::Look};
use channels::Names;
use perturb_mujoco::Error;
use pristine::Pristine;
use std::sync::OnceLock;

/// MJCF elements that are added to a robot's model for pictures: an endless ground, because the floor of the physics is
/// drawn only up to 40 m from the start, and a line that marks the goal.
pub(super) const SCENERY: &str = include_str!("../../../models/scenery.xml");

/// The description of a robot: its specification, model, names of joints and geoms, and the rule that decides whether
/// it is alive.
pub(super) struct Robot {
    pub spec: &'static EnvironmentSpec,
    /// The model, and the camera and scenery of its pictures.
    pub look: Look,
    pub names: Names,
    pub alive: fn(&Posture<'_>) -> bool,
    /// The compiled model. The model is compiled once in the process, when an environment first needs it.
    pub pristine: OnceLock<Result<Pristine, Error>>,
}

/// The quantities that decide whether a robot is alive.
pub(super) struct Posture<'a> {
    /// The height of the torso's centre of mass above the floor, in m.
    pub height: f64,
    /// The rotation of the torso about the y axis, in rad.
    pub pitch: f64,
    /// Whether each geom in [`Names::contacts`] touched anything at the end of the previous step.
    pub contacts: &'a [bool],
}
