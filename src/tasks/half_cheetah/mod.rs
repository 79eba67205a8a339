//! HalfCheetah: run forward on two legs.

use super::locomotion::{
    Posture, Robot, SCENERY, Walker,
    channels::{APPLIED, CONTROL_TIMESTEP, DENSITY, FRICTION, Names, PUSH, REWARD_TERMS, SUCCESS, names, power},
    colours::*,
};
use crate::{
    env::{ActionSpace, EnvironmentSpec, Error},
    scene::{Look, ModelView, Scenery},
};
use std::sync::OnceLock;

/// The specification of HalfCheetah.
///
/// | observation | value, clipped to ±5 |
/// |---|---|
/// | 0 | height of the torso above that at the reset, m |
/// | 1, 2 | sine and cosine of the angle to the target: 0 and 1 |
/// | 3 … 5 | 0.3 × the torso's velocity along x, y, z in m/s |
/// | 6, 7 | roll (0) and pitch of the torso, rad |
/// | 8 … 19 | bthigh, bshin, bfoot, fthigh, fshin, ffoot: position in the joint's range scaled to ±1, and 0.1 × speed in rad/s |
/// | 20 … 25 | whether ffoot, fshin, fthigh, bfoot, bshin, bthigh touch the floor, one step late |
///
/// Actions: the six motors' controls, clipped to ±1, times `power`, times 120, 90, 60, 140, 60 and 30 N m. Reward: see
/// [`Walker`]. Start: joints uniform in ±0.1 rad within their range, at rest. The cheetah is alive while its pitch is
/// within ±1 rad and no thigh or shin touches the floor.
///
/// Revision 0: Roboschool's `RoboschoolHalfCheetah-v1` on MuJoCo.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "HalfCheetah",
    revision: 0,
    description: "Run forward on two legs without falling.",
    make: &|| Ok(Box::new(half_cheetah()?)),
    parameters: &[power(0.9, (0.7, 1.1), (0.5, 1.3)), DENSITY, FRICTION],
    observation: NAMES.observation,
    action: ActionSpace::Continuous(NAMES.action),
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

/// Makes a half cheetah with default parameters.
///
/// # Errors
/// [`Error::Model`] if MuJoCo is of another version or has no memory.
pub fn half_cheetah() -> Result<Walker, Error> {
    Walker::new(&ROBOT)
}

fn alive(posture: &Posture<'_>) -> bool {
    let &[_ffoot, fshin, fthigh, _bfoot, bshin, bthigh] = posture.contacts else { return false };
    posture.pitch.abs() < 1.0 && !(fshin || fthigh || bshin || bthigh)
}
