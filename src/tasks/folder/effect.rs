//! Finds edits without a visible effect: the physics is the same, byte for byte, at both ends of E.

use super::environment::Task;
use crate::{
    env::{Purpose, Stream},
    tasks::shared,
};
use perturb_mujoco::{Error, Simulation};

/// Number of timesteps of random controls from the initial state.
const N_STEPS: usize = 200;

/// Returns the parameters whose edits change nothing in 200 timesteps of random controls from the initial state. They
/// may still have an effect in other states: a friction has none before the robot falls.
///
/// # Errors
/// MuJoCo's fatal ones.
pub(super) fn unseen(task: &'static Task) -> Result<Vec<&'static str>, Error> {
    let defaults: Vec<f64> = task.spec.parameters.iter().map(|parameter| parameter.default).collect();
    let own = trajectory(task, &defaults)?;
    let mut unseen = Vec::new();
    for (i, parameter) in task.spec.parameters.iter().enumerate() {
        let at = |value: f64| {
            let mut values = defaults.clone();
            values[i] = value;
            trajectory(task, &values)
        };
        let [below, above] = parameter.extreme;
        if at(below.low)? == own && at(above.high)? == own {
            unseen.push(parameter.name);
        }
    }
    Ok(unseen)
}

/// Returns the states, as bits, after each timestep of random controls, until the physics diverge.
fn trajectory(task: &'static Task, values: &[f64]) -> Result<Vec<u64>, Error> {
    let edit = task.template.edit(&task.parameters, values)?;
    shared::with(&task.template, |shared| {
        let (simulation, _) = shared.at(&edit, &task.template.state)?;
        let mut stream = Stream::new(0, 0, Purpose::InitialState, 0);
        let mut states = Vec::new();
        for _ in 0..N_STEPS {
            for (ctrl, &(low, high)) in simulation.ctrl_mut().iter_mut().zip(&task.controls) {
                *ctrl = stream.uniform(low, high);
            }
            if let Err(error) = simulation.step() {
                return if simulation.is_poisoned() { Err(error) } else { Ok(states) };
            }
            states.extend(bits(simulation));
        }
        Ok(states)
    })
}

fn bits(simulation: &Simulation) -> impl Iterator<Item = u64> + '_ {
    simulation.qpos().iter().chain(simulation.qvel()).map(|value| value.to_bits())
}
