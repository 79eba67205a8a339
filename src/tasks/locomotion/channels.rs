//! The parts that the specifications of Hopper and HalfCheetah share. These are the channels (the entries of
//! observations, actions and states), the reward terms, the parameters, the quantities in receipts, the pushes and the
//! success rule.

use crate::env::{
    Achievement, ChannelSpec, ParameterSpec, PushSpec, QuantitySpec, RewardTermSpec, SuccessComparison, SuccessRuleSpec,
};

/// Maximal absolute value of an observed number. Larger values are clipped.
pub const CLIP: f64 = 5.0;
/// The simulated time of one step, in s.
pub const CONTROL_TIMESTEP: f64 = 0.0165;

/// The names of a robot's joints and geoms, and the channels that follow from them.
pub struct Names {
    /// The joints with motors, in the order of observations and actions.
    pub joints: &'static [&'static str],
    /// The geoms whose contacts are observed, in the order of the observation.
    pub contacts: &'static [&'static str],
    /// The entries of an observation: of the torso, the joints and the contacts.
    pub observation: &'static [ChannelSpec],
    /// The entries of an action.
    pub action: &'static [ChannelSpec],
    /// The entries of an exact state. The bounds of the entries are far beyond the values of any episode, and exclude
    /// only absurd numbers.
    pub state: &'static [ChannelSpec],
}

/// Makes the [`Names`] of a robot from the names of its joints and of the geoms whose contacts are observed.
macro_rules! names {
    (joints: [$($joint:literal),*], contacts: [$($contact:literal),*]) => {{
        use crate::{env::ChannelSpec, tasks::locomotion::channels::{CLIP, Names}};

        Names {
            joints: &[$($joint),*],
            contacts: &[$($contact),*],
            observation: &[
                // The robot moves in a plane, so the angle to the target, the speed along y and the roll are constant.
                ChannelSpec::new("torso_height", "m", -CLIP, CLIP).scale(1.0),
                ChannelSpec::new("target_sin", "1", -1.0, 1.0).scale(0.0),
                ChannelSpec::new("target_cos", "1", -1.0, 1.0).scale(0.0),
                ChannelSpec::new("torso_velocity_x", "1", -CLIP, CLIP).scale(1.0),
                ChannelSpec::new("torso_velocity_y", "1", -CLIP, CLIP).scale(0.0),
                ChannelSpec::new("torso_velocity_z", "1", -CLIP, CLIP).scale(1.0),
                ChannelSpec::new("roll", "rad", -CLIP, CLIP).scale(0.0),
                ChannelSpec::new("pitch", "rad", -CLIP, CLIP).scale(1.0),
                $(
                    ChannelSpec::new(concat!($joint, "_position"), "1", -CLIP, CLIP).scale(1.0),
                    ChannelSpec::new(concat!($joint, "_speed"), "1", -CLIP, CLIP).scale(1.0),
                )*
                $(ChannelSpec::new(concat!($contact, "_contact"), "1", 0.0, 1.0),)*
            ],
            action: &[$(ChannelSpec::new($joint, "1", -1.0, 1.0)),*],
            state: &[
                ChannelSpec::new("root_x", "m", -1e4, 1e4),
                ChannelSpec::new("root_z", "m", -1e2, 1e2),
                ChannelSpec::new("root_pitch", "rad", -1e2, 1e2),
                $(ChannelSpec::new($joint, "rad", -1e2, 1e2),)*
                ChannelSpec::new("root_x_velocity", "m/s", -1e3, 1e3),
                ChannelSpec::new("root_z_velocity", "m/s", -1e3, 1e3),
                ChannelSpec::new("root_pitch_velocity", "rad/s", -1e3, 1e3),
                $(ChannelSpec::new(concat!($joint, "_velocity"), "rad/s", -1e3, 1e3),)*
            ],
        }
    }};
}
pub(in crate::tasks) use names;

/// The terms of the reward of both robots.
pub const REWARD_TERMS: &[RewardTermSpec] = &[
    RewardTermSpec { name: "alive", description: "1 while alive, else -1" },
    RewardTermSpec {
        name: "progress",
        description: "Δx / 0.0165 s, x the mean of the bodies' centres of mass along the track",
    },
    RewardTermSpec { name: "electricity", description: "-2 mean |a · 0.1 q̇|, a as received, q̇ after the step" },
    RewardTermSpec { name: "stall_torque", description: "-0.1 mean a², a as received" },
    RewardTermSpec { name: "joint_limits", description: "-0.2 for each joint beyond 99 % of its range" },
];

/// Returns the parameter `power`, a factor on the motors' controls, with the values of its versions as in
/// [`ParameterSpec::versions`].
pub const fn power(default: f64, random: (f64, f64), around: (f64, f64)) -> ParameterSpec {
    ParameterSpec::new("power", "1", "factor on every motor's control", (0.0, 10.0))
        .versions(default, random, around)
        .read_back_by("control_factor")
}

/// The parameter `density` of both robots: the density of the torso.
pub const DENSITY: ParameterSpec =
    ParameterSpec::new("density", "kg/m³", "density of the torso body", (10.0, 100_000.0)).versions(
        1000.0,
        (750.0, 1250.0),
        (500.0, 1500.0),
    );
/// The parameter `friction` of both robots: the sliding friction of all geoms except the floor.
pub const FRICTION: ParameterSpec =
    ParameterSpec::new("friction", "1", "sliding friction of the robot's geoms", (0.0, 10.0)).versions(
        0.8,
        (0.5, 1.1),
        (0.2, 1.4),
    );

/// The physical quantities that receipts of both robots report.
pub const APPLIED: &[QuantitySpec] = &[
    QuantitySpec { name: "torso_mass", unit: "kg" },
    QuantitySpec { name: "friction", unit: "1" },
    QuantitySpec { name: "control_factor", unit: "1" },
    QuantitySpec { name: "density", unit: "kg/m³" },
];

/// The pushes that can be applied to both robots.
pub const PUSH: Option<PushSpec> =
    Some(PushSpec { description: "impulse of a push on the torso along x", unit: "N s", axes: &[0] });

/// The success rule of both robots.
pub const SUCCESS: SuccessRuleSpec = SuccessRuleSpec {
    description: "the torso's x reached 20 m at any step, the last one included",
    achievement: Achievement::Own(QuantitySpec { name: "distance", unit: "m" }),
    comparison: SuccessComparison::AtLeast,
    threshold: 20.0,
};
