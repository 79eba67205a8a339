//! HalfCheetah: run forward on two legs.

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

/// The specification of HalfCheetah.
///
/// | observation | value, clipped to ±5 |
/// |---|---|
/// | 0 | height of the torso minus its height at the reset, m |
/// | 1, 2 | sine and cosine of the angle to the target: 0 and 1 |
/// | 3 … 5 | 0.3 × the torso's velocity along x, y, z in m/s |
/// | 6, 7 | roll (0) and pitch of the torso, rad |
/// | 8 … 19 | bthigh, bshin, bfoot, fthigh, fshin, ffoot: position, scaled so that the joint's range becomes ±1, and 0.1 × speed in rad/s |
/// | 20 … 25 | whether ffoot, fshin, fthigh, bfoot, bshin, bthigh touched the floor at the end of the previous step |
///
/// Actions: the controls of the six motors. Each is clipped to ±1, and multiplied by `power` and by 120, 90, 60, 140,
/// 60 or 30 N m. Reward: see [`Walker`]. Start: joint positions uniform in ±0.1 rad, clipped to the joints' ranges, at
/// rest. The cheetah is alive while its pitch is within ±1 rad and the observed contacts of thighs and shins are 0.
///
/// Source: Roboschool's `RoboschoolHalfCheetah-v1`, here simulated by MuJoCo.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "HalfCheetah",
    revision: 0,
    description: "Run forward on two legs without falling.",
    make: &|| Ok(Box::new(half_cheetah()?)),
    parameters: &[power(0.9, (0.7, 1.1), (0.5, 1.3)), DENSITY, FRICTION],
    observation: NAMES.observation,
    action: ActionSpec::Continuous(NAMES.action),
    state: NAMES.state,
    reward_terms: REWARD_TERMS,
    applied: APPLIED,
    step_limit: 1000,
    control_timestep: CONTROL_TIMESTEP,
    step_cost: 29.0,
    push: PUSH,
    success: SUCCESS,
    code_success: None,
    heatmap_axes: Some(["density", "friction"]),
};

const NAMES: Names = names!(joints: ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"], contacts: ["ffoot", "fshin", "fthigh", "bfoot", "bshin", "bthigh"]);

static ROBOT: Robot = Robot {
    spec: &SPEC,
    look: Look {
        name: SPEC.name,
        mjcf: include_str!("../../../models/half_cheetah.xml"),
        files: &[],
        scenery: Some(Scenery {
            mjcf: SCENERY,
            hidden: "floor",
            colours: &[
                ("torso", GREY),
                ("head", GREY),
                ("bthigh", BLUE),
                ("bshin", BLUE),
                ("bfoot", SKY_BLUE),
                ("fthigh", VERMILLION),
                ("fshin", VERMILLION),
                ("ffoot", ORANGE),
            ],
        }),
        view: ModelView::Beside { followed: "torso", distance: 3.0, height: 0.55 },
    },
    names: NAMES,
    alive,
    pristine: OnceLock::new(),
};

/// Creates a half cheetah with default parameters.
///
/// # Errors
/// [`Error::Model`] if the MuJoCo library has the wrong version or there is not enough memory.
pub fn half_cheetah() -> Result<Walker, Error> {
    Walker::new(&ROBOT)
}

fn alive(posture: &Posture<'_>) -> bool {
    let &[_ffoot, fshin, fthigh, _bfoot, bshin, bthigh] = posture.contacts else { return false };
    posture.pitch.abs() < 1.0 && !(fshin || fthigh || bshin || bthigh)
}
