//! The disturbed twin of an environment: a wrapper that disturbs its actions, observations and physics.

use super::{
    actions::ActionPath,
    changes::ChangingPhysics,
    parameters::{DisturbanceSet, DisturbanceValues},
    sensors::SensorPath,
};
use crate::{
    env::{Action, Draw, DrawPurpose, Environment, EnvironmentSpec, Error, PhiloxStream, Transition},
    scene::Scene,
};

/// An environment whose actions, observations and physics are disturbed. Rewards, ends of episodes, success and
/// pictures come from the wrapped environment, so noise and delay of observations do not affect them.
pub(super) struct Disturbed {
    physics: ChangingPhysics,
    spec: &'static EnvironmentSpec,
    set: &'static DisturbanceSet,
    /// The requested values of the disturbances, in the order of the parameters of `set`.
    numbers: Vec<f64>,
    values: DisturbanceValues,
    draw: Draw,
    /// Number of steps that the episode has taken.
    steps: u32,
    actions: ActionPath,
    sensors: SensorPath,
}

impl Disturbed {
    /// Wraps `inner`. `spec` describes the disturbed twin, `set` its disturbances. The disturbances have no effect
    /// until `set_parameters` is called.
    pub(super) fn new(
        inner: Box<dyn Environment>,
        spec: &'static EnvironmentSpec,
        set: &'static DisturbanceSet,
    ) -> Self {
        let mut neutral = vec![0.0; set.action_width];
        inner.neutral_action(&mut neutral);
        let mut disturbed = Self {
            physics: ChangingPhysics::new(inner),
            spec,
            set,
            numbers: set.parameters().map(|parameter| parameter.default).collect(),
            values: set.defaults(),
            draw: Draw::default(),
            steps: 0,
            actions: ActionPath::new(spec.action, neutral),
            sensors: SensorPath::new(spec.observation),
        };
        disturbed.begin();
        disturbed
    }

    /// Begins an episode in the current state of the physics.
    fn begin(&mut self) {
        self.steps = 0;
        self.physics.environment.push([0.0; 3]); // clears a push that remained if the last episode diverged
        self.actions.begin(&self.values);
        self.sensors.begin(&self.values, |out| self.physics.environment.observe(out));
    }
}

impl Environment for Disturbed {
    fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    fn set_parameters(&mut self, values: &[f64]) {
        let (own, disturbances) = values.split_at(values.len() - self.numbers.len());
        self.numbers.copy_from_slice(disturbances);
        self.set.set(&mut self.values, disturbances);
        self.physics.set_parameters(own, &self.values);
    }

    fn applied(&self, out: &mut [f64]) {
        let (own, disturbances) = out.split_at_mut(out.len() - self.numbers.len());
        self.physics.applied(own);
        self.set.read(&self.values, &self.numbers, |parameter| self.physics.changed(parameter), disturbances);
    }

    fn model_hash(&self) -> &str {
        self.physics.environment.model_hash()
    }

    fn achieved(&self) -> Option<f64> {
        self.physics.environment.achieved()
    }

    fn set_address(&mut self, draw: Draw, steps: u32) {
        (self.draw, self.steps) = (draw, steps);
        self.physics.environment.set_address(draw, steps);
    }

    fn neutral_action(&self, out: &mut [f32]) {
        self.physics.environment.neutral_action(out);
    }

    fn reset(&mut self, stream: &mut PhiloxStream) {
        self.physics.begin();
        self.physics.environment.reset(stream);
        self.begin();
    }

    fn reset_to(&mut self, state: &[f64]) {
        self.physics.begin();
        self.physics.environment.reset_to(state);
        self.begin();
    }

    fn observe(&self, out: &mut [f32]) {
        self.sensors.observe(&self.values, &self.draw, self.steps, out);
    }

    fn draw_ahead(&mut self) {
        self.actions.draw_ahead(&self.values, &self.draw, self.steps);
        self.sensors.draw_ahead(&self.values, &self.draw, self.steps + 1);
    }

    fn scene(&self) -> Option<Scene> {
        self.physics.environment.scene()
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let action = self.actions.apply(&self.values, &self.draw, self.steps, action);
        if self.values.push > 0.0
            && let Some(push) = self.spec.push
            && let Some(impulse) = impulse(&self.values, &self.draw, self.steps, push.axes)
        {
            self.physics.environment.push(impulse);
        }
        let transition = if self.physics.apply(&self.values, &self.draw, self.steps) {
            self.physics.environment.step(action, reward_terms)
        } else {
            reward_terms.fill(0.0);
            Transition { terminated: true, goal: false, diverged: true }
        };
        self.steps += 1;
        self.sensors.apply(|out| self.physics.environment.observe(out));
        transition
    }

    /// Appends the state of the physics, then the last action and the delayed actions, then the delayed observations.
    /// The noise of the present observation is not stored: `observe` draws it again from the random stream of the step.
    fn save(&self, out: &mut Vec<f64>) {
        self.physics.save(out);
        self.actions.save(out);
        self.sensors.save(out);
    }

    fn max_saved_growth(&self) -> usize {
        let (actions, sensors) = self.set.max_late_numbers(self.spec.observation.len());
        let now = self.actions.n_saved(&self.values) - self.set.action_width + self.sensors.n_saved(&self.values);
        self.physics.environment.max_saved_growth() + (actions + sensors).saturating_sub(now)
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        let (actions, sensors) = (self.actions.n_saved(&self.values), self.sensors.n_saved(&self.values));
        let Some(own) = state.len().checked_sub(actions + sensors) else {
            let reason = format!("its state has {} numbers, expected more than {}", state.len(), actions + sensors);
            return Err(Error::Snapshot { reason });
        };
        let (own, late) = state.split_at(own);
        let (late_actions, late_observations) = late.split_at(actions);
        self.physics.load(own)?;
        self.physics.environment.push([0.0; 3]); // clears a push of the replaced episode
        self.actions.load(&self.values, late_actions)?;
        self.sensors.load(&self.values, late_observations, |out| self.physics.environment.observe(out))
    }
}

/// Draws whether step number `step` has a push. Returns the push's impulse along x, y and z; `None` without a push.
fn impulse(values: &DisturbanceValues, draw: &Draw, step: u32, axes: &[usize]) -> Option<[f64; 3]> {
    let mut stream = PhiloxStream::at_step(draw, DrawPurpose::Push, step);
    if stream.unit() * values.push_interval >= 1.0 {
        return None;
    }
    let mut impulse = [0.0; 3];
    for (&axis, part) in axes.iter().zip(stream.direction(axes.len())) {
        impulse[axis] = values.push * part;
    }
    Some(impulse)
}
