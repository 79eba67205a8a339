//! Fuzz targets for task folders: `task.toml` and MJCF files, before MuJoCo compiles them.

use perturb::env::{Action, Environment};
use perturb::tasks::folder;

/// A model with a joint, a body, a geom, a site, an actuator and a sensor.
const MODEL: &str = include_str!("../../examples/tasks/reaching_arm/arm.xml");

/// Loads a task with this `task.toml`. If the task is valid, steps it.
pub fn tasks(data: &[u8]) {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("task.toml"), data).expect("a file");
    std::fs::write(folder.path().join("arm.xml"), MODEL).expect("a file");
    let Ok(loaded) = folder::load(folder.path()) else { return };
    let spec = loaded.spec();
    let mut environment: Box<dyn Environment> = (spec.make)().expect("memory for a simulation");
    let defaults: Vec<f64> = spec.parameters.iter().map(|parameter| parameter.default).collect();
    environment.set_parameters(&defaults);
    environment.step(Action::Continuous(&[0.5, -0.5]), &mut vec![0.0; spec.reward_terms.len()]);
    let mut state = Vec::new();
    environment.save(&mut state);
    environment.load(&state).expect("what was saved");
}

/// Reads a task's model, but does not compile it. MuJoCo's compiler may abort the process, and therefore perturb runs
/// it in a separate process.
pub fn models(data: &[u8]) {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("task.toml"), "").expect("a file");
    std::fs::write(folder.path().join("included.xml"), "<mujoco><asset/></mujoco>").expect("a file");
    std::fs::write(folder.path().join("robot.xml"), data).expect("a file");
    let _ = folder::read_model(folder.path(), "robot.xml");
}
