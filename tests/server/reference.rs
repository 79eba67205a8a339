//! The classic control tasks agree with Gymnasium: recorded trajectories of Gymnasium 1.4 in f64 under edited
//! parameters.

use perturb::{
    env::{Action, Environment, Transition},
    tasks::{self, pendulum::Pendulum},
};
use serde_json::Value;

const GOLDEN: &str = include_str!("data/classic_control.jsonl");

/// The tolerance of a single step: a few dozen operations, each with a rounding error of 1.1e-16, amplified by at most
/// a few hundred (by the short light poles of E). It allows another order of the same operations, but no error of the
/// model.
const SINGLE_STEP: f64 = 1e-12;
/// The tolerance of a trajectory: over 50 steps, errors of single steps grow less than a thousandfold.
const TRAJECTORY: f64 = 1e-9;
const TRAJECTORY_STEPS: usize = 50;
/// The tolerance of rounding to f32: half an ulp on each side. It is relative, or absolute for numbers below 1.
const OBSERVATION: f64 = 1.2e-7;

/// A recorded trajectory.
struct Case {
    name: String,
    environment: String,
    parameters: Vec<f64>,
    actions: Vec<f64>,
    /// The initial state, and the state after each action.
    states: Vec<Vec<f64>>,
    observations: Vec<Vec<f64>>,
    rewards: Vec<f64>,
    terminated: Vec<bool>,
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn cases() -> Vec<Case> {
    let case = |(i, line): (usize, &str)| {
        let row: Value = serde_json::from_str(line).unwrap();
        let environment = row["env"].as_str().unwrap().to_owned();
        let spec = tasks::catalogue().find(&environment).unwrap();
        let list = |key: &str| row[key].as_array().unwrap().iter().map(numbers).collect::<Vec<_>>();
        let states = std::iter::once(numbers(&row["state0"])).chain(list("states")).collect();
        Case {
            name: format!("line {} ({environment} {})", i + 1, row["version"]),
            parameters: spec.parameters.iter().map(|p| row["params"][p.name].as_f64().unwrap()).collect(),
            actions: numbers(&row["actions"]),
            states,
            observations: list("observations"),
            rewards: numbers(&row["rewards"]),
            terminated: row["terminated"].as_array().unwrap().iter().map(|x| x.as_bool().unwrap()).collect(),
            environment,
        }
    };
    GOLDEN.lines().enumerate().map(case).collect()
}

/// Replays recorded actions in an environment. Pendulum's recorded torques are f64, so they cannot be actions, which
/// are f32.
enum Replay {
    Discrete(Box<dyn Environment>),
    Pendulum(Pendulum),
}

impl Replay {
    fn new(case: &Case) -> Self {
        let mut replay = match case.environment.as_str() {
            "Pendulum" => Self::Pendulum(Pendulum::new()),
            name => Self::Discrete(tasks::catalogue().find(name).and_then(|spec| (spec.make)()).unwrap()),
        };
        replay.environment().set_parameters(&case.parameters);
        replay
    }

    fn environment(&mut self) -> &mut dyn Environment {
        match self {
            Self::Discrete(environment) => environment.as_mut(),
            Self::Pendulum(pendulum) => pendulum,
        }
    }

    fn step(&mut self, action: f64) -> (Transition, f64) {
        let mut terms = vec![f64::NAN; self.environment().spec().reward_terms.len()];
        let transition = match self {
            Self::Discrete(environment) => environment.step(Action::Discrete(action as u32), &mut terms),
            Self::Pendulum(pendulum) => pendulum.step_with_torque(action, &mut terms),
        };
        (transition, terms.iter().sum())
    }

    fn state(&mut self) -> Vec<f64> {
        let mut state = Vec::new();
        self.environment().save(&mut state);
        state
    }

    fn observation(&mut self) -> Vec<f64> {
        let mut out = vec![f32::NAN; self.environment().spec().observation.len()];
        self.environment().observe(&mut out);
        out.into_iter().map(f64::from).collect()
    }
}

/// Returns the relative deviation, or the absolute one for numbers below 1.
fn deviation(got: f64, expected: f64) -> f64 {
    (got - expected).abs() / expected.abs().max(1.0)
}

/// Updates the largest deviation. Fails if a deviation is not below the tolerance, or is NaN.
fn compare(largest: &mut f64, tolerance: f64, got: &[f64], expected: &[f64], place: &str) {
    assert_eq!(got.len(), expected.len(), "{place}");
    for (&got, &expected) in got.iter().zip(expected) {
        let deviation = deviation(got, expected);
        assert!(deviation <= tolerance, "{place}: got {got}, expected {expected}, off by {deviation:e}");
        *largest = largest.max(deviation);
    }
}

#[test]
fn there_are_six_cases_of_each_classic_task() {
    let cases = cases();
    for name in ["CartPole", "MountainCar", "Acrobot", "Pendulum"] {
        assert_eq!(cases.iter().filter(|case| case.environment == name).count(), 6, "{name}");
    }
    for case in cases {
        let steps = case.actions.len();
        let lengths = [case.states.len() - 1, case.observations.len() - 1, case.rewards.len(), case.terminated.len()];
        assert_eq!(lengths, [steps; 4], "{}", case.name);
    }
}

#[test]
fn every_single_step_agrees_with_gymnasium() {
    let (mut in_state, mut in_reward, mut in_observation) = (0.0, 0.0, 0.0);
    for case in cases() {
        let mut replay = Replay::new(&case);
        for (t, &action) in case.actions.iter().enumerate() {
            let place = format!("{}, step {}", case.name, t + 1);
            replay.environment().reset_to(&case.states[t]);
            compare(&mut in_observation, OBSERVATION, &replay.observation(), &case.observations[t], &place);
            let (transition, reward) = replay.step(action);
            compare(&mut in_state, SINGLE_STEP, &replay.state(), &case.states[t + 1], &place);
            compare(&mut in_reward, SINGLE_STEP, &[reward], &[case.rewards[t]], &place);
            compare(&mut in_observation, OBSERVATION, &replay.observation(), &case.observations[t + 1], &place);
            assert_eq!(transition.terminated, case.terminated[t], "{place}");
            assert!(!transition.diverged, "{place}");
        }
    }
    println!("largest deviation of a single step: state {in_state:e}, reward {in_reward:e}, f32 {in_observation:e}");
}

#[test]
fn trajectories_from_the_initial_state_agree_with_gymnasium() {
    let (mut in_state, mut in_reward) = (0.0, 0.0);
    for case in cases() {
        let mut replay = Replay::new(&case);
        replay.environment().reset_to(&case.states[0]);
        for (t, &action) in case.actions.iter().enumerate().take(TRAJECTORY_STEPS) {
            let place = format!("{}, step {}", case.name, t + 1);
            let (transition, reward) = replay.step(action);
            compare(&mut in_state, TRAJECTORY, &replay.state(), &case.states[t + 1], &place);
            compare(&mut in_reward, TRAJECTORY, &[reward], &[case.rewards[t]], &place);
            assert_eq!(transition.terminated, case.terminated[t], "{place}");
        }
    }
    println!("largest deviation over {TRAJECTORY_STEPS} steps: state {in_state:e}, reward {in_reward:e}");
}

#[test]
fn an_action_of_f32_is_the_same_torque_in_f64() {
    let (mut by_action, mut by_torque) = (Pendulum::new(), Pendulum::new());
    for torque in [0.0, 0.3, -1.7, 2.0, 2.5, -9.0_f32] {
        let (mut a, mut b) = ([0.0; 3], [0.0; 3]);
        let transition = by_action.step(Action::Continuous(&[torque]), &mut a);
        assert_eq!((transition, a), (by_torque.step_with_torque(torque.into(), &mut b), b));
    }
    let (mut a, mut b) = (Vec::new(), Vec::new());
    by_action.save(&mut a);
    by_torque.save(&mut b);
    assert_eq!(a, b);
}
