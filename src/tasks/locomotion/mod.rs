//! The task that Hopper and HalfCheetah share, Roboschool's (Brockman et al., 2016; Schulman et al., 2017) on MuJoCo 2.2.2.
//!
//! [`Walker`] is the task. Environments take turns in a simulation of their thread (`tasks/shared.rs`). Each robot's folder
//! has the robot's own numbers. The models are in `models/`, with the source of each number.

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

/// MJCF that pictures add to a robot's own elements. The drawn floor of the physics ends 40 m from the start, but this
/// ground does not. The line marks the goal.
pub(super) const SCENERY: &str = include_str!("../../../models/scenery.xml");

/// A robot: its specification, model, names of joints and geoms, and the rule whether it is alive.
pub(super) struct Robot {
    pub spec: &'static EnvironmentSpec,
    /// The model and its look in pictures.
    pub look: Look,
    pub names: Names,
    pub alive: fn(&Posture<'_>) -> bool,
    /// The model, which is compiled once in the process.
    pub pristine: OnceLock<Result<Pristine, Error>>,
}

/// The values that decide whether a robot is alive.
pub(super) struct Posture<'a> {
    /// The torso's centre of mass above the floor, m.
    pub height: f64,
    /// The torso's turn about +y, rad.
    pub pitch: f64,
    /// The contact flags of the step before, in the task's order.
    pub contacts: &'a [bool],
}
