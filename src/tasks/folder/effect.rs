//! Finds parameters without a visible effect: a short simulation gives the same bytes with the extreme values of
//! version E as with the defaults.

use super::environment::FolderTask;
use crate::{
    env::{DrawPurpose, PhiloxStream},
    tasks::shared,
};
use perturb_mujoco::{Error, Simulation};

/// Number of timesteps in each simulation that [`parameters_without_effect`] compares.
const N_STEPS: usize = 200;

/// Returns the names of the parameters that change nothing in 200 timesteps with random controls from the initial
/// state. A returned parameter may have an effect in other states; for instance, friction has none before the robot
/// touches the floor.
///
/// # Errors
/// MuJoCo's fatal errors.
pub(super) fn parameters_without_effect(task: &'static FolderTask) -> Result<Vec<&'static str>, Error> {
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

/// Simulates [`N_STEPS`] timesteps with random controls, and returns the bits of all positions and velocities after
/// each timestep. Stops early if the physics diverge. `values` are the values of the parameters.
fn trajectory(task: &'static FolderTask, values: &[f64]) -> Result<Vec<u64>, Error> {
    let edit = task.template.edit(&task.parameters, values)?;
    shared::with(&task.template, |shared| {
        let (simulation, _) = shared.at(&edit, &task.template.state)?;
        let mut stream = PhiloxStream::new(0, 0, DrawPurpose::InitialState, 0);
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
