//! Pendulum: swing a rod up with a weak torque and hold it there.
//!
//! Source: Gymnasium 1.4 `Pendulum-v1`, g = 10 m/s². The speed is clipped before the angle is updated. The Gym of 2018,
//! which the paper used, clipped the speed afterwards.

mod drawing;

use super::analytic;
use crate::{
    env::{
        Achievement, Action, ActionSpec, ChannelSpec, Environment, EnvironmentSpec, Error, ParameterSpec, PhiloxStream,
        PushSpec, QuantitySpec, RewardTermSpec, SuccessComparison, SuccessRuleSpec, Transition,
    },
    scene::Scene,
};
use std::f64::consts::PI;

/// The specification of Pendulum.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "Pendulum",
    revision: 1,
    description: "Swing a rod up with a weak torque and hold it upright.",
    make: &|| Ok(Box::new(Pendulum::new())),
    parameters: &[
        ParameterSpec::new("length", "m", "length of the rod", (0.01, 100.0)).versions(1.0, (0.75, 1.25), (0.5, 1.5)),
        ParameterSpec::new("mass", "kg", "mass of the rod", (0.001, 1000.0)).versions(1.0, (0.75, 1.25), (0.5, 1.5)),
    ],
    observation: &[
        ChannelSpec::new("cos_theta", "1", -1.0, 1.0),
        ChannelSpec::new("sin_theta", "1", -1.0, 1.0),
        ChannelSpec::new("theta_velocity", "rad/s", -MAX_SPEED, MAX_SPEED),
    ],
    action: ActionSpec::Continuous(&[ChannelSpec::new("torque", "N m", -MAX_TORQUE, MAX_TORQUE)]),
    state: &[
        ChannelSpec::new("theta", "rad", -MAX_INITIAL_ANGLE, MAX_INITIAL_ANGLE),
        ChannelSpec::new("theta_velocity", "rad/s", -MAX_SPEED, MAX_SPEED),
    ],
    reward_terms: &[
        RewardTermSpec { name: "angle", description: "-θ², θ wrapped into [-π, π), before the step" },
        RewardTermSpec { name: "velocity", description: "-0.1 θ̇², before the step" },
        RewardTermSpec { name: "torque", description: "-0.001 u², u clipped to ±2" },
    ],
    applied: &[QuantitySpec { name: "length", unit: "m" }, QuantitySpec { name: "mass", unit: "kg" }],
    step_limit: STEP_LIMIT,
    control_timestep: DT,
    step_cost: 0.05,
    push: Some(PushSpec { description: "impulse of a push on the joint", unit: "N m s", axes: &[0] }),
    success: SuccessRuleSpec {
        description: "the angle was within π/3 of vertical after each of the last 100 steps",
        achievement: Achievement::LastGoals,
        comparison: SuccessComparison::AtLeast,
        threshold: 100.0,
    },
    code_success: Some(SuccessRuleSpec {
        description: "the angle was within π/3 of vertical after each of 100 successive steps, wherever in the episode",
        achievement: Achievement::LongestGoals,
        comparison: SuccessComparison::AtLeast,
        threshold: 100.0,
    }),
    heatmap_axes: Some(["mass", "length"]),
};

const DT: f64 = 0.05;
const GRAVITY: f64 = 10.0;
const MAX_SPEED: f64 = 8.0;
const MAX_TORQUE: f64 = 2.0;
const STEP_LIMIT: u32 = 200;
const MAX_INITIAL_ANGLE: f64 = 10_000.0;
/// Maximal absolute angle in a snapshot, in rad. Angles are not wrapped, so this is the largest initial angle plus the
/// turn of an episode at maximal speed, with one more step as a margin.
const MAX_ANGLE: f64 = MAX_INITIAL_ANGLE + (STEP_LIMIT + 1) as f64 * MAX_SPEED * DT;
const UPRIGHT: f64 = PI / 3.0;

/// A Pendulum: its parameters and state.
#[derive(Debug, Clone)]
pub struct Pendulum {
    length: f64,
    mass: f64,
    /// The angle from upright in rad, not wrapped, and its velocity in rad/s.
    state: [f64; 2],
    /// The torque of the last step in N m; `None` after a reset. Only pictures use it.
    torque: Option<f64>,
    /// The angular impulse on the joint in the next step, in N m s.
    push: f64,
}

impl Pendulum {
    /// Creates a Pendulum with default parameters, upright at rest.
    pub fn new() -> Self {
        let [length, mass] = [0, 1].map(|i: usize| SPEC.parameters[i].default);
        Self { length, mass, state: [0.0; 2], torque: None, push: 0.0 }
    }

    /// Advances by one step with a torque in N m, which is clipped to ±2. The torque is f64, although actions are f32,
    /// because tests compare with reference trajectories of f64 torques.
    pub fn step_with_torque(&mut self, torque: f64, reward_terms: &mut [f64]) -> Transition {
        let [theta, velocity] = self.state;
        let (m, l) = (self.mass, self.length);
        let u = torque.clamp(-MAX_TORQUE, MAX_TORQUE);
        self.torque = Some(u);
        let angle = normalise(theta);
        reward_terms.copy_from_slice(&[-(angle * angle), -(0.1 * (velocity * velocity)), -(0.001 * (u * u))]);

        let torque = if self.push == 0.0 { u } else { u + std::mem::take(&mut self.push) / DT };
        let acceleration = 3.0 * GRAVITY / (2.0 * l) * libm::sin(theta) + 3.0 / (m * (l * l)) * torque;
        let velocity = (velocity + acceleration * DT).clamp(-MAX_SPEED, MAX_SPEED);
        let diverged = analytic::advance(&mut self.state, [theta + velocity * DT, velocity]);
        Transition { terminated: diverged, goal: normalise(self.state[0]).abs() < UPRIGHT, diverged }
    }
}

impl Default for Pendulum {
    fn default() -> Self {
        Self::new()
    }
}

/// Wraps an angle in rad into [-π, π), by a remainder like Python's `%`.
fn normalise(angle: f64) -> f64 {
    (angle + PI).rem_euclid(2.0 * PI) - PI
}

impl Environment for Pendulum {
    fn spec(&self) -> &'static EnvironmentSpec {
        &SPEC
    }

    fn set_parameters(&mut self, values: &[f64]) {
        (self.length, self.mass) = (values[0], values[1]);
    }

    fn applied(&self, out: &mut [f64]) {
        out.copy_from_slice(&[self.length, self.mass]);
    }

    fn push(&mut self, [impulse, ..]: [f64; 3]) {
        self.push = impulse;
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.state = [stream.uniform(-PI, PI), stream.uniform(-1.0, 1.0)];
        self.torque = None;
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.state.copy_from_slice(state);
        self.torque = None;
    }

    fn observe(&self, out: &mut [f32]) {
        let [theta, velocity] = self.state;
        let (sin, cos) = libm::sincos(theta);
        out.copy_from_slice(&[cos as f32, sin as f32, velocity as f32]);
    }

    fn scene(&self) -> Option<Scene> {
        let [angle, _] = self.state;
        Some(Scene::Drawing(drawing::drawing(angle, self.length, self.torque)))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let Action::Continuous(&[torque]) = action else {
            unreachable!("Pendulum is stepped with one validated torque")
        };
        self.step_with_torque(f64::from(torque), reward_terms)
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.state);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        self.state = analytic::load(state, [MAX_ANGLE, MAX_SPEED])?;
        self.torque = None;
        Ok(())
    }
}
