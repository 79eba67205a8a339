//! HalfCheetah: run forward on two legs.

use super::locomotion::{
    Posture, SCENERY, Task, Walker,
    channels::{
        APPLIED, CONTROL_TIMESTEP, DENSITY, FRICTION, REWARD_TERMS, SUCCESS, joint_state, position, power, root_state,
        speed, torso, velocity,
    },
    colours::*,
};
use crate::{
    env::{ActionSpace, Channel, EnvironmentSpec, Error},
    scene::Look,
};
use std::sync::OnceLock;

/// What is fixed about HalfCheetah.
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
    make: || Ok(Box::new(half_cheetah()?)),
    parameters: &[power(0.9, (0.7, 1.1), (0.5, 1.3)), DENSITY, FRICTION],
    observation: &[
        torso::HEIGHT,
        torso::TARGET_SIN,
        torso::TARGET_COS,
        torso::VELOCITY_X,
        torso::VELOCITY_Y,
        torso::VELOCITY_Z,
        torso::ROLL,
        torso::PITCH,
        position("bthigh_position"),
        speed("bthigh_speed"),
        position("bshin_position"),
        speed("bshin_speed"),
        position("bfoot_position"),
        speed("bfoot_speed"),
        position("fthigh_position"),
        speed("fthigh_speed"),
        position("fshin_position"),
        speed("fshin_speed"),
        position("ffoot_position"),
        speed("ffoot_speed"),
        Channel::new("ffoot_contact", "1", 0.0, 1.0),
        Channel::new("fshin_contact", "1", 0.0, 1.0),
        Channel::new("fthigh_contact", "1", 0.0, 1.0),
        Channel::new("bfoot_contact", "1", 0.0, 1.0),
        Channel::new("bshin_contact", "1", 0.0, 1.0),
        Channel::new("bthigh_contact", "1", 0.0, 1.0),
    ],
    action: ActionSpace::Continuous(&[
        Channel::new("bthigh", "1", -1.0, 1.0),
        Channel::new("bshin", "1", -1.0, 1.0),
        Channel::new("bfoot", "1", -1.0, 1.0),
        Channel::new("fthigh", "1", -1.0, 1.0),
        Channel::new("fshin", "1", -1.0, 1.0),
        Channel::new("ffoot", "1", -1.0, 1.0),
    ]),
    state: &[
        root_state::X,
        root_state::Z,
        root_state::PITCH,
        joint_state("bthigh"),
        joint_state("bshin"),
        joint_state("bfoot"),
        joint_state("fthigh"),
        joint_state("fshin"),
        joint_state("ffoot"),
        root_state::X_VELOCITY,
        root_state::Z_VELOCITY,
        root_state::PITCH_VELOCITY,
        velocity("bthigh_velocity"),
        velocity("bshin_velocity"),
        velocity("bfoot_velocity"),
        velocity("fthigh_velocity"),
        velocity("fshin_velocity"),
        velocity("ffoot_velocity"),
    ],
    reward_terms: REWARD_TERMS,
    applied: APPLIED,
    step_limit: 1000,
    control_timestep: CONTROL_TIMESTEP,
    step_cost: 29.0,
    success: SUCCESS,
    heatmap_axes: Some(["density", "friction"]),
};

static TASK: Task = Task {
    spec: &SPEC,
    look: Look {
        name: SPEC.name,
        mjcf: include_str!("../../../models/half_cheetah.xml"),
        scenery: SCENERY,
        hidden: "floor",
        followed: "torso",
        camera_distance: 3.0,
        camera_height: 0.55,
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
    },
    joints: &["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"],
    contacts: &["ffoot", "fshin", "fthigh", "bfoot", "bshin", "bthigh"],
    alive,
    pristine: OnceLock::new(),
};

/// A half cheetah with default parameters.
///
/// # Errors
/// [`Error::Model`] if MuJoCo is of another version or has no memory.
pub fn half_cheetah() -> Result<Walker, Error> {
    Walker::new(&TASK)
}

fn alive(posture: &Posture<'_>) -> bool {
    let &[_ffoot, fshin, fthigh, _bfoot, bshin, bthigh] = posture.contacts else { return false };
    posture.pitch.abs() < 1.0 && !(fshin || fthigh || bshin || bthigh)
}
