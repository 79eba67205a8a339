//! Acrobot: a two-link pendulum with a motor at the elbow must swing its tip above a line.
//!
//! Source: Sutton (1996); Gymnasium 1.4 `Acrobot-v1` ("book" equations, fourth-order Runge-Kutta). As in the paper's
//! code, the links' centres of mass stay at 0.5 m when the parameter `length` changes.

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

/// The specification of Acrobot.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "Acrobot",
    revision: 1,
    description: "Swing the tip of a two-link pendulum above a line.",
    make: &|| Ok(Box::new(Acrobot::new())),
    parameters: &[
        ParameterSpec::new("length", "m", "length of both links", (0.01, 100.0)).versions(
            1.0,
            (0.75, 1.25),
            (0.5, 1.5),
        ),
        ParameterSpec::new("mass", "kg", "mass of both links", (0.001, 1000.0)).versions(1.0, (0.75, 1.25), (0.5, 1.5)),
        ParameterSpec::new("moi", "kg m²", "moment of inertia of both links", (0.001, 1000.0)).versions(
            1.0,
            (0.75, 1.25),
            (0.5, 1.5),
        ),
    ],
    observation: &[
        ChannelSpec::new("cos_theta1", "1", -1.0, 1.0),
        ChannelSpec::new("sin_theta1", "1", -1.0, 1.0),
        ChannelSpec::new("cos_theta2", "1", -1.0, 1.0),
        ChannelSpec::new("sin_theta2", "1", -1.0, 1.0),
        ChannelSpec::new("theta1_velocity", "rad/s", -MAX_VELOCITY_1, MAX_VELOCITY_1),
        ChannelSpec::new("theta2_velocity", "rad/s", -MAX_VELOCITY_2, MAX_VELOCITY_2),
    ],
    action: ActionSpec::Discrete(&["torque_minus_1", "torque_0", "torque_plus_1"]),
    state: &[
        ChannelSpec::new("theta1", "rad", -PI, PI),
        ChannelSpec::new("theta2", "rad", -PI, PI),
        ChannelSpec::new("theta1_velocity", "rad/s", -MAX_VELOCITY_1, MAX_VELOCITY_1),
        ChannelSpec::new("theta2_velocity", "rad/s", -MAX_VELOCITY_2, MAX_VELOCITY_2),
    ],
    reward_terms: &[RewardTermSpec {
        name: "time",
        description: "-1 for every step, 0 for the one that ends the task",
    }],
    applied: &[
        QuantitySpec { name: "length", unit: "m" },
        QuantitySpec { name: "mass", unit: "kg" },
        QuantitySpec { name: "moi", unit: "kg m²" },
    ],
    step_limit: 500,
    control_timestep: DT,
    step_cost: 0.3,
    push: Some(PushSpec { description: "impulse of a push on the first joint", unit: "N m s", axes: &[0] }),
    success: SuccessRuleSpec {
        description: "the height was reached within 80 steps",
        achievement: Achievement::FirstGoal,
        comparison: SuccessComparison::AtMost,
        threshold: 80.0,
    },
    code_success: Some(SuccessRuleSpec {
        description: "the height was reached within 90 steps",
        achievement: Achievement::FirstGoal,
        comparison: SuccessComparison::AtMost,
        threshold: 90.0,
    }),
    heatmap_axes: Some(["length", "mass"]),
};

const DT: f64 = 0.2;
const GRAVITY: f64 = 9.8;
const CENTRE_OF_MASS: f64 = 0.5;
const MAX_VELOCITY_1: f64 = 4.0 * PI;
const MAX_VELOCITY_2: f64 = 9.0 * PI;
const HEIGHT: f64 = 1.0;
const RESET_RANGE: f64 = 0.1;

/// An Acrobot: its parameters and state.
#[derive(Debug, Clone)]
pub struct Acrobot {
    link_length: f64,
    link_mass: f64,
    link_moi: f64,
    /// The angle of link 1 from hanging down, the angle of link 2 relative to link 1, in rad, and their velocities in
    /// rad/s.
    state: [f64; 4],
    /// The angular impulse on the first joint in the next step, in N m s.
    push: f64,
}

impl Acrobot {
    /// Creates an Acrobot with default parameters, hanging down at rest.
    pub fn new() -> Self {
        let [link_length, link_mass, link_moi] = [0, 1, 2].map(|i: usize| SPEC.parameters[i].default);
        Self { link_length, link_mass, link_moi, state: [0.0; 4], push: 0.0 }
    }

    /// Returns the time derivative of a state (Sutton and Barto, "book" version). `torque` acts on the second joint,
    /// and `push` acts on the first joint. Both are in N m.
    fn derivative(&self, [theta1, theta2, dtheta1, dtheta2]: [f64; 4], torque: f64, push: f64) -> [f64; 4] {
        let (m1, m2) = (self.link_mass, self.link_mass);
        let (lc1, lc2) = (CENTRE_OF_MASS, CENTRE_OF_MASS);
        let (i1, i2) = (self.link_moi, self.link_moi);
        let l1 = self.link_length;
        let g = GRAVITY;
        let (sin2, cos2) = libm::sincos(theta2);
        let d1 = m1 * lc1 * lc1 + m2 * (l1 * l1 + lc2 * lc2 + 2.0 * l1 * lc2 * cos2) + i1 + i2;
        let d2 = m2 * (lc2 * lc2 + l1 * lc2 * cos2) + i2;
        let phi2 = m2 * lc2 * g * libm::cos(theta1 + theta2 - PI / 2.0);
        let phi1 = -m2 * l1 * lc2 * dtheta2 * dtheta2 * sin2 - 2.0 * m2 * l1 * lc2 * dtheta2 * dtheta1 * sin2
            + (m1 * lc1 + m2 * l1) * g * libm::cos(theta1 - PI / 2.0)
            + phi2
            - push;
        let ddtheta2 = (torque + d2 / d1 * phi1 - m2 * l1 * lc2 * dtheta1 * dtheta1 * sin2 - phi2)
            / (m2 * lc2 * lc2 + i2 - d2 * d2 / d1);
        let ddtheta1 = -(d2 * ddtheta2 + phi1) / d1;
        [dtheta1, dtheta2, ddtheta1, ddtheta2]
    }

    fn runge_kutta(&self, state: [f64; 4], torque: f64, push: f64) -> [f64; 4] {
        let along = |k: [f64; 4], h: f64| std::array::from_fn(|i| state[i] + h * k[i]);
        let k1 = self.derivative(state, torque, push);
        let k2 = self.derivative(along(k1, DT / 2.0), torque, push);
        let k3 = self.derivative(along(k2, DT / 2.0), torque, push);
        let k4 = self.derivative(along(k3, DT), torque, push);
        std::array::from_fn(|i| state[i] + DT / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]))
    }
}

impl Default for Acrobot {
    fn default() -> Self {
        Self::new()
    }
}

/// Wraps an angle in rad into [-π, π]. Like Gymnasium it adds or subtracts 2π in a loop, because a remainder would
/// round differently. Extreme parameters can cause angles so large that the loop would take too long. Such angles are
/// wrapped by a remainder.
fn wrap(mut angle: f64) -> f64 {
    if angle.abs() > 1000.0 * PI {
        return (angle + PI).rem_euclid(2.0 * PI) - PI;
    }
    while angle > PI {
        angle -= 2.0 * PI;
    }
    while angle < -PI {
        angle += 2.0 * PI;
    }
    angle
}

impl Environment for Acrobot {
    fn spec(&self) -> &'static EnvironmentSpec {
        &SPEC
    }

    fn set_parameters(&mut self, values: &[f64]) {
        (self.link_length, self.link_mass, self.link_moi) = (values[0], values[1], values[2]);
    }

    fn applied(&self, out: &mut [f64]) {
        out.copy_from_slice(&[self.link_length, self.link_mass, self.link_moi]);
    }

    fn push(&mut self, [impulse, ..]: [f64; 3]) {
        self.push = impulse;
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.state = analytic::draw(stream, -RESET_RANGE, RESET_RANGE);
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.state.copy_from_slice(state);
    }

    fn observe(&self, out: &mut [f32]) {
        let [theta1, theta2, dtheta1, dtheta2] = self.state;
        let ((sin1, cos1), (sin2, cos2)) = (libm::sincos(theta1), libm::sincos(theta2));
        let values = [cos1, sin1, cos2, sin2, dtheta1, dtheta2];
        out.copy_from_slice(&values.map(|x| x as f32));
    }

    fn scene(&self) -> Option<Scene> {
        let [theta1, theta2, _, _] = self.state;
        Some(Scene::Drawing(drawing::drawing([theta1, theta2], self.link_length)))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let torque = f64::from(analytic::choice(action)) - 1.0;
        let push = std::mem::take(&mut self.push) / DT;
        let [theta1, theta2, dtheta1, dtheta2] = self.runge_kutta(self.state, torque, push);
        let next = [
            wrap(theta1),
            wrap(theta2),
            dtheta1.clamp(-MAX_VELOCITY_1, MAX_VELOCITY_1),
            dtheta2.clamp(-MAX_VELOCITY_2, MAX_VELOCITY_2),
        ];
        let diverged = analytic::advance(&mut self.state, next);

        let goal = -libm::cos(self.state[0]) - libm::cos(self.state[1] + self.state[0]) > HEIGHT;
        reward_terms[0] = if goal { 0.0 } else { -1.0 };
        Transition { terminated: goal || diverged, goal, diverged }
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.state);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        self.state = analytic::load(state, [PI, PI, MAX_VELOCITY_1, MAX_VELOCITY_2])?;
        Ok(())
    }
}
