//! The parts that the specs of Hopper and HalfCheetah share: channels, reward terms, quantities.

use crate::env::{Achievement, Channel, Comparison, Parameter, Quantity, RewardTerm, Success};

/// Observations are clipped to ± this.
pub const CLIP: f64 = 5.0;
/// Simulated seconds in one step.
pub const CONTROL_TIMESTEP: f64 = 0.0165;

/// The torso's entries of an observation.
pub mod torso {
    use super::{CLIP, Channel};

    pub const HEIGHT: Channel = Channel::new("torso_height", "m", -CLIP, CLIP);
    pub const TARGET_SIN: Channel = Channel::new("target_sin", "1", -1.0, 1.0);
    pub const TARGET_COS: Channel = Channel::new("target_cos", "1", -1.0, 1.0);
    pub const VELOCITY_X: Channel = Channel::new("torso_velocity_x", "1", -CLIP, CLIP);
    pub const VELOCITY_Y: Channel = Channel::new("torso_velocity_y", "1", -CLIP, CLIP);
    pub const VELOCITY_Z: Channel = Channel::new("torso_velocity_z", "1", -CLIP, CLIP);
    pub const ROLL: Channel = Channel::new("roll", "rad", -CLIP, CLIP);
    pub const PITCH: Channel = Channel::new("pitch", "rad", -CLIP, CLIP);
}

/// A joint's position, scaled.
pub const fn position(name: &'static str) -> Channel {
    Channel::new(name, "1", -CLIP, CLIP)
}

/// A joint's speed, scaled.
pub const fn speed(name: &'static str) -> Channel {
    Channel::new(name, "1", -CLIP, CLIP)
}

/// The root's entries of an exact state. The bounds are far beyond any episode and keep absurd numbers out.
pub mod root_state {
    use super::Channel;

    pub const X: Channel = Channel::new("root_x", "m", -1e4, 1e4);
    pub const Z: Channel = Channel::new("root_z", "m", -1e2, 1e2);
    pub const PITCH: Channel = Channel::new("root_pitch", "rad", -1e2, 1e2);
    pub const X_VELOCITY: Channel = Channel::new("root_x_velocity", "m/s", -1e3, 1e3);
    pub const Z_VELOCITY: Channel = Channel::new("root_z_velocity", "m/s", -1e3, 1e3);
    pub const PITCH_VELOCITY: Channel = Channel::new("root_pitch_velocity", "rad/s", -1e3, 1e3);
}

/// A joint's entry of an exact state.
pub const fn joint_state(name: &'static str) -> Channel {
    Channel::new(name, "rad", -1e2, 1e2)
}

/// A joint's velocity in an exact state.
pub const fn velocity(name: &'static str) -> Channel {
    Channel::new(name, "rad/s", -1e3, 1e3)
}

/// The reward's terms.
pub const REWARD_TERMS: &[RewardTerm] = &[
    RewardTerm { name: "alive", description: "1 while alive, else -1" },
    RewardTerm {
        name: "progress",
        description: "Δx / 0.0165 s, x the mean of the bodies' centres of mass along the track",
    },
    RewardTerm { name: "electricity", description: "-2 mean |a · 0.1 q̇|, a as received, q̇ after the step" },
    RewardTerm { name: "stall_torque", description: "-0.1 mean a², a as received" },
    RewardTerm { name: "joint_limits", description: "-0.2 for each joint beyond 99 % of its range" },
];

/// The power of the motors, with the sets of its versions: see [`Parameter::versions`].
pub const fn power(default: f64, random: (f64, f64), around: (f64, f64)) -> Parameter {
    Parameter::new("power", "1", "factor on every motor's control", (0.0, 10.0))
        .versions(default, random, around)
        .read_back_by("control_factor")
}

/// The torso's density.
pub const DENSITY: Parameter = Parameter::new("density", "kg/m³", "density of the torso body", (10.0, 100_000.0))
    .versions(1000.0, (750.0, 1250.0), (500.0, 1500.0));
/// The robot's friction.
pub const FRICTION: Parameter = Parameter::new("friction", "1", "sliding friction of the robot's geoms", (0.0, 10.0))
    .versions(0.8, (0.5, 1.1), (0.2, 1.4));

/// What receipts read back.
pub const APPLIED: &[Quantity] = &[
    Quantity { name: "torso_mass", unit: "kg" },
    Quantity { name: "friction", unit: "1" },
    Quantity { name: "control_factor", unit: "1" },
    Quantity { name: "density", unit: "kg/m³" },
];

/// The same goal for both.
pub const SUCCESS: Success = Success {
    description: "the torso's x reached 20 m at any step, the last one included",
    achievement: Achievement::Own(Quantity { name: "distance", unit: "m" }),
    comparison: Comparison::AtLeast,
    threshold: 20.0,
};
