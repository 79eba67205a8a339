//! CartPole: a pole hinged on a cart that is pushed left or right.
//!
//! Source: Barto, Sutton and Anderson (1983); Gymnasium 1.4 `CartPole-v1` (explicit Euler) with the paper's step limit.

mod drawing;

use super::analytic;
use crate::{
    env::{
        Achievement, Action, ActionSpec, ChannelSpec, Environment, EnvironmentSpec, Error, ParameterSpec, PhiloxStream,
        PushSpec, QuantitySpec, RewardTermSpec, SuccessComparison, SuccessRuleSpec, Transition,
    },
    scene::Scene,
};

/// The specification of CartPole. Observations have no bounds, because the last observation of an episode may be beyond
/// the limits that end the episode.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "CartPole",
    revision: 1,
    description: "Balance a pole on a cart by pushing the cart left or right.",
    make: &|| Ok(Box::new(CartPole::new())),
    parameters: &[
        ParameterSpec::new("force", "N", "push on the cart", (0.0, 1000.0)).versions(10.0, (5.0, 15.0), (1.0, 20.0)),
        ParameterSpec::new("length", "m", "half the pole's length", (0.001, 100.0)).versions(
            0.5,
            (0.25, 0.75),
            (0.05, 1.0),
        ),
        ParameterSpec::new("mass", "kg", "the pole's mass", (0.0001, 1000.0)).versions(0.1, (0.05, 0.5), (0.01, 1.0)),
    ],
    observation: &[
        ChannelSpec::unbounded("cart_position", "m").scale(POSITION_LIMIT),
        ChannelSpec::unbounded("cart_velocity", "m/s"),
        ChannelSpec::unbounded("pole_angle", "rad").scale(ANGLE_LIMIT),
        ChannelSpec::unbounded("pole_angular_velocity", "rad/s"),
    ],
    action: ActionSpec::Discrete(&["push_left", "push_right"]),
    state: &[
        ChannelSpec::new("cart_position", "m", -POSITION_LIMIT, POSITION_LIMIT),
        ChannelSpec::new("cart_velocity", "m/s", -100.0, 100.0),
        ChannelSpec::new("pole_angle", "rad", -ANGLE_LIMIT, ANGLE_LIMIT),
        ChannelSpec::new("pole_angular_velocity", "rad/s", -100.0, 100.0),
    ],
    reward_terms: &[RewardTermSpec { name: "survival", description: "1 for every step, the last included" }],
    applied: &[
        QuantitySpec { name: "force", unit: "N" },
        QuantitySpec { name: "length", unit: "m" },
        QuantitySpec { name: "mass", unit: "kg" },
        QuantitySpec { name: "total_mass", unit: "kg" },
        QuantitySpec { name: "pole_mass_length", unit: "kg m" },
    ],
    step_limit: 200,
    control_timestep: TAU,
    step_cost: 0.04,
    push: Some(PushSpec { description: "impulse of a push on the cart", unit: "N s", axes: &[0] }),
    success: SuccessRuleSpec {
        description: "the episode lasted at least 195 steps",
        achievement: Achievement::Length,
        comparison: SuccessComparison::AtLeast,
        threshold: 195.0,
    },
    // The paper's code compares the length with 195 after each step. That code resets an ended environment before the
    // comparison, so the step that ends the episode does not count.
    code_success: Some(SuccessRuleSpec {
        description: "the episode lasted at least 196 steps",
        achievement: Achievement::Length,
        comparison: SuccessComparison::AtLeast,
        threshold: 196.0,
    }),
    heatmap_axes: Some(["length", "mass"]),
};

const GRAVITY: f64 = 9.8;
const CART_MASS: f64 = 1.0;
const TAU: f64 = 0.02;
const ANGLE_LIMIT: f64 = 12.0 * 2.0 * std::f64::consts::PI / 360.0;
const POSITION_LIMIT: f64 = 2.4;
const RESET_RANGE: f64 = 0.05;

/// A CartPole: its parameters and state.
#[derive(Debug, Clone)]
pub struct CartPole {
    force: f64,
    half_pole_length: f64,
    pole_mass: f64,
    // Quantities that `set_parameters` derives. The reciprocal saves three divisions in each step, which would take
    // half of a step's time. It makes results differ from Gymnasium's by some 1e-16.
    pole_mass_length: f64,
    inverse_total_mass: f64,
    /// The cart's position in m and velocity in m/s, the pole's angle from upright in rad and angular velocity in
    /// rad/s.
    state: [f64; 4],
    /// The impulse on the cart in the next step, in N s.
    push: f64,
}

impl CartPole {
    /// Creates a CartPole with default parameters, at rest and upright.
    pub fn new() -> Self {
        let mut cart_pole = Self {
            force: 0.0,
            half_pole_length: 0.0,
            pole_mass: 0.0,
            pole_mass_length: 0.0,
            inverse_total_mass: 0.0,
            state: [0.0; 4],
            push: 0.0,
        };
        cart_pole.set_parameters(&[0, 1, 2].map(|i: usize| SPEC.parameters[i].default));
        cart_pole
    }
}

impl Default for CartPole {
    fn default() -> Self {
        Self::new()
    }
}

impl Environment for CartPole {
    fn spec(&self) -> &'static EnvironmentSpec {
        &SPEC
    }

    fn set_parameters(&mut self, values: &[f64]) {
        (self.force, self.half_pole_length, self.pole_mass) = (values[0], values[1], values[2]);
        self.pole_mass_length = self.pole_mass * self.half_pole_length;
        self.inverse_total_mass = 1.0 / (self.pole_mass + CART_MASS);
    }

    fn applied(&self, out: &mut [f64]) {
        let total_mass = self.pole_mass + CART_MASS;
        let values = [self.force, self.half_pole_length, self.pole_mass, total_mass, self.pole_mass_length];
        out.copy_from_slice(&values);
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
        out.copy_from_slice(&self.state.map(|x| x as f32));
    }

    fn scene(&self) -> Option<Scene> {
        let [position, _, angle, _] = self.state;
        Some(Scene::Drawing(drawing::drawing(position, angle, self.half_pole_length)))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let [x, x_dot, theta, theta_dot] = self.state;
        let mut force = if analytic::choice(action) == 1 { self.force } else { -self.force };
        if self.push != 0.0 {
            force += std::mem::take(&mut self.push) / TAU;
        }
        let (sin, cos) = libm::sincos(theta);
        let (pole_mass_length, inverse) = (self.pole_mass_length, self.inverse_total_mass);
        let temp = (force + pole_mass_length * (theta_dot * theta_dot) * sin) * inverse;
        let theta_acc = (GRAVITY * sin - cos * temp)
            / (self.half_pole_length * (4.0 / 3.0 - self.pole_mass * (cos * cos) * inverse));
        let x_acc = temp - pole_mass_length * theta_acc * cos * inverse;
        let next = [x + TAU * x_dot, x_dot + TAU * x_acc, theta + TAU * theta_dot, theta_dot + TAU * theta_acc];
        let diverged = analytic::advance(&mut self.state, next);

        reward_terms[0] = 1.0;
        let inside = self.state[0].abs() <= POSITION_LIMIT && self.state[2].abs() <= ANGLE_LIMIT;
        Transition { terminated: !inside || diverged, goal: inside, diverged }
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.state);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        self.state = analytic::load(state, [f64::MAX; 4])?;
        Ok(())
    }
}
