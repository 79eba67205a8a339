//! Hopper: hop forward on one leg.

use super::locomotion::{
    Posture, Robot, SCENERY, Walker,
    channels::{APPLIED, CONTROL_TIMESTEP, DENSITY, FRICTION, Names, PUSH, REWARD_TERMS, SUCCESS, names, power},
    colours::*,
};
use crate::{
    env::{ActionSpec, EnvironmentSpec, Error},
    scene::{Look, ModelView, Scenery},
};
use std::sync::OnceLock;

/// The specification of Hopper.
///
/// | observation | value, clipped to ±5 |
/// |---|---|
/// | 0 | height of the torso minus its height at the reset, m |
/// | 1, 2 | sine and cosine of the angle to the target: 0 and 1 |
/// | 3 … 5 | 0.3 × the torso's velocity along x, y, z in m/s |
/// | 6, 7 | roll (0) and pitch of the torso, rad |
/// | 8 … 13 | thigh, leg, foot: position, scaled so that the joint's range becomes ±1, and 0.1 × speed in rad/s |
/// | 14 | whether the foot touched the floor at the end of the previous step |
///
/// Actions: the controls of the three motors. Each is clipped to ±1, and multiplied by `power` and by 100 N m. Reward:
/// see [`Walker`]. Start: joint positions uniform in ±0.1 rad, clipped to the joints' ranges, at rest. The hopper is
/// alive while its torso's centre of mass is above 0.8 m and its pitch is within ±1 rad.
///
/// Source: Roboschool's `RoboschoolHopper-v1`, here simulated by MuJoCo.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "Hopper",
    revision: 0,
    description: "Hop forward on one leg without falling.",
    make: &|| Ok(Box::new(hopper()?)),
    parameters: &[power(0.75, (0.6, 0.9), (0.4, 1.1)), DENSITY, FRICTION],
    observation: NAMES.observation,
    action: ActionSpec::Continuous(NAMES.action),
    state: NAMES.state,
    reward_terms: REWARD_TERMS,
    applied: APPLIED,
    step_limit: 1000,
    control_timestep: CONTROL_TIMESTEP,
    step_cost: 20.0,
    push: PUSH,
    success: SUCCESS,
    code_success: None,
    heatmap_axes: Some(["density", "friction"]),
};

const NAMES: Names = names!(joints: ["thigh", "leg", "foot"], contacts: ["foot"]);

static ROBOT: Robot = Robot {
    spec: &SPEC,
    look: Look {
        name: SPEC.name,
        mjcf: include_str!("../../../models/hopper.xml"),
        files: &[],
        scenery: Some(Scenery {
            mjcf: SCENERY,
            hidden: "floor",
            colours: &[("torso", BLUE), ("thigh", SKY_BLUE), ("leg", ORANGE), ("foot", VERMILLION)],
        }),
        view: ModelView::Beside { followed: "torso", distance: 3.0, height: 0.75 },
    },
    names: NAMES,
    alive,
    pristine: OnceLock::new(),
};

/// Creates a hopper with default parameters.
///
/// # Errors
/// [`Error::Model`] if the MuJoCo library has the wrong version or there is not enough memory.
pub fn hopper() -> Result<Walker, Error> {
    Walker::new(&ROBOT)
}

fn alive(posture: &Posture<'_>) -> bool {
    posture.height > 0.8 && posture.pitch.abs() < 1.0
}
