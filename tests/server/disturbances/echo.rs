//! An environment whose observation contains the actions that reached it.

use perturb::{
    env::{
        Achievement, Action, ActionSpec, ChannelSpec, Environment, EnvironmentSpec, Error, PhiloxStream, PushSpec,
        RewardTermSpec, SuccessComparison, SuccessRuleSpec, Transition,
    },
    scene::Scene,
};

/// The description: two motors; observations are their last actions, the number of steps, and a constant.
pub static SPEC: EnvironmentSpec = EnvironmentSpec {
    name: "Echo",
    revision: 0,
    description: "Observe what acts.",
    make: &|| Ok(Box::new(Echo { state: [f64::NAN; 6], is_pushed: false })),
    parameters: &[],
    observation: &[
        ChannelSpec::unbounded("left", "1"),
        ChannelSpec::unbounded("right", "1").scale(3.0),
        ChannelSpec::unbounded("steps", "1"),
        ChannelSpec::unbounded("constant", "1").scale(0.0),
        ChannelSpec::unbounded("push_x", "N s").scale(0.0),
        ChannelSpec::unbounded("push_z", "N s").scale(0.0),
    ],
    action: ActionSpec::Continuous(&[
        ChannelSpec::new("left", "1", -1.0, 1.0),
        ChannelSpec::new("right", "1", 0.5, 2.5),
    ]),
    state: &[],
    reward_terms: &[RewardTermSpec { name: "left", description: "the left action" }],
    applied: &[],
    step_limit: 1_000_000,
    control_timestep: 1.0,
    step_cost: 0.1,
    success: SuccessRuleSpec {
        description: "never",
        achievement: Achievement::FirstGoal,
        comparison: SuccessComparison::AtMost,
        threshold: 0.0,
    },
    push: Some(PushSpec { description: "a push", unit: "N s", axes: &[0, 2] }),
    code_success: None,
    heatmap_axes: None,
};

/// The constant in the observation.
pub const CONSTANT: f32 = 7.0;

struct Echo {
    /// The last actions of both motors, the number of steps, the constant, and the two components of the last step's
    /// push.
    state: [f64; 6],
    /// Whether the next step has a push.
    is_pushed: bool,
}

impl Environment for Echo {
    fn spec(&self) -> &'static EnvironmentSpec {
        &SPEC
    }

    fn set_parameters(&mut self, _: &[f64]) {}

    fn applied(&self, _: &mut [f64]) {}

    fn push(&mut self, [x, y, z]: [f64; 3]) {
        assert_eq!(y, 0.0, "it has no axis y");
        (self.state[4], self.state[5]) = (x, z);
        self.is_pushed = true;
    }

    fn reset(&mut self, _: &mut PhiloxStream) {
        self.state = [0.0, 0.0, 0.0, CONSTANT.into(), 0.0, 0.0];
    }

    fn reset_to(&mut self, _: &[f64]) {
        self.state = [0.0, 0.0, 0.0, CONSTANT.into(), 0.0, 0.0];
    }

    fn observe(&self, out: &mut [f32]) {
        out.copy_from_slice(&self.state.map(|x| x as f32));
    }

    fn scene(&self) -> Option<Scene> {
        None
    }

    fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        let Action::Continuous(&[left, right]) = action else { unreachable!("two motors") };
        let push = if std::mem::take(&mut self.is_pushed) { [self.state[4], self.state[5]] } else { [0.0; 2] };
        self.state = [left.into(), right.into(), self.state[2] + 1.0, self.state[3], push[0], push[1]];
        reward_terms[0] = left.into();
        Transition { terminated: false, goal: false, diverged: false }
    }

    fn save(&self, out: &mut Vec<f64>) {
        out.extend_from_slice(&self.state);
    }

    fn load(&mut self, state: &[f64]) -> Result<(), Error> {
        self.state = state.try_into().map_err(|_| Error::Snapshot { reason: "six numbers".into() })?;
        Ok(())
    }
}
