//! MountainCar: a car whose engine is too weak for a hill must gain speed by swinging back and forth.
//!
//! Source: Moore (1990); Gymnasium 1.4 `MountainCar-v0`.

mod drawing;

use super::analytic;
use crate::{
    env::{
        Achievement, Action, ActionSpec, ChannelSpec, Environment, EnvironmentSpec, Error, ParameterSpec, PhiloxStream,
        PushSpec, QuantitySpec, RewardTermSpec, SuccessComparison, SuccessRuleSpec, Transition,
    },
    scene::Scene,
};

const STATE: &[ChannelSpec] = &[
    ChannelSpec::new("position", "m", MIN_POSITION, MAX_POSITION),
    ChannelSpec::new("velocity", "m/step", -MAX_SPEED, MAX_SPEED),
];

/// The specification of MountainCar.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "MountainCar",
    revision: 1,
    description: "Swing an underpowered car up a hill.",
    make: &|| Ok(Box::new(MountainCar::new())),
    parameters: &[
        ParameterSpec::new("force", "1", "the engine's push per step", (0.0, 1.0)).versions(
            0.001,
            (0.0005, 0.005),
            (0.0001, 0.01),
        ),
        ParameterSpec::new("mass", "1", "the gravity term's factor", (0.0, 1.0)).versions(
            0.0025,
            (0.001, 0.005),
            (0.0005, 0.01),
        ),
    ],
    observation: STATE,
    action: ActionSpec::Discrete(&["push_left", "coast", "push_right"]),
    state: STATE,
    reward_terms: &[RewardTermSpec { name: "time", description: "-1 for every step" }],
    applied: &[QuantitySpec { name: "force", unit: "1" }, QuantitySpec { name: "mass", unit: "1" }],
    step_limit: 200,
    control_timestep: 1.0,
    step_cost: 0.04,
    push: Some(PushSpec { description: "change of velocity by a push on the car", unit: "1", axes: &[0] }),
    success: SuccessRuleSpec {
        description: "the goal was reached within 110 steps",
        achievement: Achievement::FirstGoal,
        comparison: SuccessComparison::AtMost,
        threshold: 110.0,
    },
    code_success: None,
    heatmap_axes: Some(["force", "mass"]),
};

const MIN_POSITION: f64 = -1.2;
const MAX_POSITION: f64 = 0.6;
const MAX_SPEED: f64 = 0.07;
const GOAL_POSITION: f64 = 0.5;
const GOAL_VELOCITY: f64 = 0.0;

/// A MountainCar: its parameters and state.
#[derive(Debug, Clone)]
pub struct MountainCar {
    force: f64,
    /// The factor of the gravity term, which the paper calls mass, in m/step².
    gravity: f64,
    /// Position in m, and velocity in m/step.
    state: [f64; 2],
    /// The change of velocity by a push in the next step, in m/step.
    push: f64,
}

impl MountainCar {
    /// Creates a MountainCar with default parameters, at rest near the bottom of the valley.
    pub fn new() -> Self {
        let [force, gravity] = [0, 1].map(|i: usize| SPEC.parameters[i].default);
        Self { force, gravity, state: [-0.5, 0.0], push: 0.0 }
    }
}

impl Default for MountainCar {
    fn default() -> Self {
        Self::new()
    }
}

impl Environment for MountainCar {
    fn spec(&self) -> &'static EnvironmentSpec {
        &SPEC
    }

    fn set_parameters(&mut self, values: &[f64]) {
        (self.force, self.gravity) = (values[0], values[1]);
    }

    fn applied(&self, out: &mut [f64]) {
        out.copy_from_slice(&[self.force, self.gravity]);
    }

    fn push(&mut self, [impulse, ..]: [f64; 3]) {
        self.push = impulse;
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.state = [stream.uniform(-0.6, -0.4), 0.0];
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.state.copy_from_slice(state);
    }

    fn observe(&self, out: &mut [f32]) {
        out.copy_from_slice(&self.state.map(|x| x as f32));
    }

    fn scene(&self) -> Option<Scene> {
        let [position, _] = self.state;
        Some(Scene::Drawing(drawing::drawing(position)))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let [mut position, mut velocity] = self.state;
        let engine = f64::from(analytic::choice(action)) - 1.0;
        velocity += engine * self.force + libm::cos(3.0 * position) * -self.gravity;
        if self.push != 0.0 {
            velocity += std::mem::take(&mut self.push);
        }
        velocity = velocity.clamp(-MAX_SPEED, MAX_SPEED);
        position = (position + velocity).clamp(MIN_POSITION, MAX_POSITION);
        if position == MIN_POSITION && velocity < 0.0 {
            velocity = 0.0; // the left end is a wall
        }
        self.state = [position, velocity];

        reward_terms[0] = -1.0;
        let goal = position >= GOAL_POSITION && velocity >= GOAL_VELOCITY;
        Transition { terminated: goal, goal, diverged: false }
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.state);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        self.state = analytic::load(state, [-MIN_POSITION, MAX_SPEED])?;
        Ok(())
    }
}
