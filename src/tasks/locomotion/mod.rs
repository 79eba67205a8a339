//! What Hopper and HalfCheetah share: Roboschool's task (Brockman et al., 2016; Schulman et al., 2017) on MuJoCo 2.2.2.
//!
//! [`Walker`] is the task; environments take turns in a simulation of their thread (`shared.rs`). The robots' folders say
//! what differs. The models are in `models/`, with the source of each number.

pub(super) mod channels;
pub(super) mod colours;
mod model_edit;
mod pristine;
mod shared;
mod walker;

pub use walker::Walker;

use crate::{env::EnvironmentSpec, scene::Look};
use channels::Names;
use perturb_mujoco::Error;
use pristine::Pristine;
use std::sync::OnceLock;

/// Follows a robot's own elements in its MJCF. The floor of the physics ends 40 m from the start, as a picture; the
/// ground here does not. The line is where the task is done.
pub(super) const SCENERY: &str = include_str!("../../../models/scenery.xml");

/// What differs between the robots.
pub(super) struct Task {
    pub spec: &'static EnvironmentSpec,
    /// The model, and how it is shown.
    pub look: Look,
    pub names: Names,
    pub alive: fn(&Posture<'_>) -> bool,
    /// Compiled once in the process.
    pub pristine: OnceLock<Result<Pristine, Error>>,
}

/// What decides whether a robot is alive.
pub(super) struct Posture<'a> {
    /// The torso's centre of mass above the floor, m.
    pub height: f64,
    /// The torso's turn about +y, rad.
    pub pitch: f64,
    /// The contact flags of the step before, in the task's order.
    pub contacts: &'a [bool],
}
