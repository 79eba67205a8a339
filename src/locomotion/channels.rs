//! The parts that the specs of Hopper and HalfCheetah share: channels, reward terms, quantities.

use crate::env::{Channel, Quantity, RewardTerm};

/// Observations are clipped to ± this.
pub(super) const CLIP: f64 = 5.0;
/// Simulated seconds in one step.
pub(super) const CONTROL_TIMESTEP: f64 = 0.0165;

/// The torso's entries of an observation.
pub(super) mod torso {
    use super::{CLIP, Channel};

    pub(in crate::locomotion) const HEIGHT: Channel = Channel::new("torso_height", "m", -CLIP, CLIP);
    pub(in crate::locomotion) const TARGET_SIN: Channel = Channel::new("target_sin", "1", -1.0, 1.0);
    pub(in crate::locomotion) const TARGET_COS: Channel = Channel::new("target_cos", "1", -1.0, 1.0);
    pub(in crate::locomotion) const VELOCITY_X: Channel = Channel::new("torso_velocity_x", "1", -CLIP, CLIP);
    pub(in crate::locomotion) const VELOCITY_Y: Channel = Channel::new("torso_velocity_y", "1", -CLIP, CLIP);
    pub(in crate::locomotion) const VELOCITY_Z: Channel = Channel::new("torso_velocity_z", "1", -CLIP, CLIP);
    pub(in crate::locomotion) const ROLL: Channel = Channel::new("roll", "rad", -CLIP, CLIP);
    pub(in crate::locomotion) const PITCH: Channel = Channel::new("pitch", "rad", -CLIP, CLIP);
}

/// A joint's position, scaled.
pub(super) const fn position(name: &'static str) -> Channel {
    Channel::new(name, "1", -CLIP, CLIP)
}

/// A joint's speed, scaled.
pub(super) const fn speed(name: &'static str) -> Channel {
    Channel::new(name, "1", -CLIP, CLIP)
}

/// The root's entries of an exact state. The bounds are far beyond any episode and keep absurd numbers out.
pub(super) mod root_state {
    use super::Channel;

    pub(in crate::locomotion) const X: Channel = Channel::new("root_x", "m", -1e4, 1e4);
    pub(in crate::locomotion) const Z: Channel = Channel::new("root_z", "m", -1e2, 1e2);
    pub(in crate::locomotion) const PITCH: Channel = Channel::new("root_pitch", "rad", -1e2, 1e2);
    pub(in crate::locomotion) const X_VELOCITY: Channel = Channel::new("root_x_velocity", "m/s", -1e3, 1e3);
    pub(in crate::locomotion) const Z_VELOCITY: Channel = Channel::new("root_z_velocity", "m/s", -1e3, 1e3);
    pub(in crate::locomotion) const PITCH_VELOCITY: Channel = Channel::new("root_pitch_velocity", "rad/s", -1e3, 1e3);
}

/// A joint's entry of an exact state.
pub(super) const fn joint_state(name: &'static str) -> Channel {
    Channel::new(name, "rad", -1e2, 1e2)
}

/// A joint's velocity in an exact state.
pub(super) const fn velocity(name: &'static str) -> Channel {
    Channel::new(name, "rad/s", -1e3, 1e3)
}

/// The reward's terms.
pub(super) const REWARD_TERMS: &[RewardTerm] = &[
    RewardTerm { name: "alive", description: "1 while alive, else -1" },
    RewardTerm {
        name: "progress",
        description: "Δx / 0.0165 s, x the mean of the bodies' centres of mass along the track",
    },
    RewardTerm { name: "electricity", description: "-2 mean |a · 0.1 q̇|, a as received, q̇ after the step" },
    RewardTerm { name: "stall_torque", description: "-0.1 mean a², a as received" },
    RewardTerm { name: "joint_limits", description: "-0.2 for each joint beyond 99 % of its range" },
];

/// What receipts read back.
pub(super) const APPLIED: &[Quantity] = &[
    Quantity { name: "torso_mass", unit: "kg" },
    Quantity { name: "friction", unit: "1" },
    Quantity { name: "control_factor", unit: "1" },
];
