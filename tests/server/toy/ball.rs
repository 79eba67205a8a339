//! A ball on a line, pushed through a viscous medium.

use perturb::{
    env::{
        Achievement, Action, ActionSpec, ChannelSpec, Environment, EnvironmentSpec, Error, ParameterSpec, PhiloxStream,
        QuantitySpec, RewardTermSpec, SuccessComparison, SuccessRuleSpec, Transition,
    },
    scene::{Drawing, Scene, colour},
};
use std::sync::atomic::{AtomicUsize, Ordering};

pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "Ball",
    revision: 0,
    description: "Push a ball along a line.",
    make: &|| Ok(Box::new(Ball { mass: 1.0, drag: 0.5, state: [0.0; 2], distance: 0.0 })),
    parameters: &[
        ParameterSpec::new("mass", "kg", "the ball's mass", (0.1, 10.0)).versions(1.0, (0.5, 2.0), (0.2, 4.0)),
        ParameterSpec::new("drag", "N s/m", "force for each m/s", (0.0, 5.0)).versions(0.5, (0.2, 0.8), (0.1, 1.0)),
    ],
    observation: STATE,
    action: ActionSpec::Continuous(&[ChannelSpec::new("force", "N", -1.0, 1.0)]),
    state: STATE,
    reward_terms: &[RewardTermSpec { name: "progress", description: "the step's way, m" }],
    applied: &[QuantitySpec { name: "mass", unit: "kg" }, QuantitySpec { name: "drag", unit: "N s/m" }],
    step_limit: 20,
    control_timestep: DT,
    step_cost: 0.1,
    success: SuccessRuleSpec {
        description: "the ball came 0.3 m far",
        achievement: Achievement::Own(QuantitySpec { name: "distance", unit: "m" }),
        comparison: SuccessComparison::AtLeast,
        threshold: 0.3,
    },
    push: None,
    code_success: None,
    heatmap_axes: Some(["mass", "drag"]),
};

const STATE: &[ChannelSpec] =
    &[ChannelSpec::new("x", "m", -100.0, 100.0), ChannelSpec::new("velocity", "m/s", -100.0, 100.0)];
const DT: f64 = 0.1;
/// An action with which the step of a ball panics.
pub const FATAL: f32 = 1e9;

struct Ball {
    mass: f64,
    drag: f64,
    state: [f64; 2],
    /// The largest x of the episode so far.
    distance: f64,
}

impl Environment for Ball {
    fn spec(&self) -> &'static EnvironmentSpec {
        &SPEC
    }

    fn set_parameters(&mut self, values: &[f64]) {
        (self.mass, self.drag) = (values[0], values[1]);
    }

    fn applied(&self, out: &mut [f64]) {
        out.copy_from_slice(&[self.mass, self.drag]);
    }

    fn achieved(&self) -> Option<f64> {
        Some(self.distance)
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.reset_to(&[stream.uniform(-0.1, 0.1), 0.0]);
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.state.copy_from_slice(state);
        self.distance = state[0];
    }

    fn observe(&self, out: &mut [f32]) {
        out.copy_from_slice(&self.state.map(|x| x as f32));
    }

    fn scene(&self) -> Option<Scene> {
        let mut drawing = Drawing::new([-1.0, -0.5], [1.0, 0.5]);
        drawing.line(&[[f64::NEG_INFINITY, -0.1], [f64::INFINITY, -0.1]], 0.02, colour::DARK);
        drawing.disc([self.state[0], 0.0], 0.1, colour::ORANGE);
        Some(Scene::Drawing(drawing))
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let Action::Continuous(&[force]) = action else { unreachable!("the server checks actions") };
        assert!(force != FATAL, "a defect, as wanted");
        let [x, velocity] = self.state;
        let velocity = velocity + DT * (f64::from(force).clamp(-1.0, 1.0) - self.drag * velocity) / self.mass;
        self.state = [x + DT * velocity, velocity];
        self.distance = self.distance.max(self.state[0]);
        reward_terms[0] = DT * velocity;
        Transition { terminated: false, goal: false, diverged: false }
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.state);
        out.push(self.distance);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        let &[x, velocity, distance] = state else { return Err(Error::Snapshot { reason: "three numbers".into() }) };
        (self.state, self.distance) = ([x, velocity], distance);
        Ok(())
    }
}

/// The number of balls that were freed by the pool's reaper thread.
pub static FREED: AtomicUsize = AtomicUsize::new(0);

impl Drop for Ball {
    fn drop(&mut self) {
        FREED.fetch_add(usize::from(std::thread::current().name() == Some("free")), Ordering::Relaxed);
    }
}
