//! Tasks that are folders: an MJCF model and a `task.toml`.

mod edits;
mod gymnasium;
mod hostile;
mod lengths;
mod readings;
mod refused;
mod served;
mod states;

use perturb::{env::EnvironmentSpec, tasks::folder};
use std::{fs, path::Path};
use tempfile::TempDir;

/// Writes a folder with these files, given by name and text.
pub fn folder(files: &[(&str, &str)]) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = directory.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    directory
}

/// Loads a folder, which must be valid.
pub fn load(path: &Path) -> &'static EnvironmentSpec {
    folder::load(path).unwrap_or_else(|error| panic!("{}: {error}", path.display())).spec()
}

/// A pendulum on a rail, with everything that a small task has.
pub const CART: &str = r#"<mujoco>
  <option timestep="0.01"/>
  <size njmax="50" nconmax="20" nstack="20000"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" pos="0 0 -1" friction="0.6 0.1 0.1"/>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="0.5" limited="true" range="-2 2"/>
      <geom name="cart" type="box" size="0.2 0.1 0.1" mass="2" contype="0" conaffinity="0"/>
      <body name="pole" pos="0 0 0">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 0.8" size="0.04" mass="0.5" friction="0.9 0.1 0.1"/>
        <site name="tip" pos="0 0 0.8"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" gear="20" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"#;

/// The task file for the model [`CART`].
pub const TASK: &str = r#"format = 1
name = "CartAndPole"
description = "Balance a pole on a cart."
model = "cart.xml"
frame_skip = 2
step_limit = 100
observation = [{ joint = "*", get = "position" }, { joint = "*", get = "velocity" }]
reward = [{ name = "alive", healthy = 1.0 }, { name = "control", squared = { action = "*" }, weight = -0.1 }]
healthy = [{ of = { joint = "hinge", get = "position" }, above = -0.5, below = 0.5 }]
success = { description = "the pole stood to the end", steps = true, at_least = 100 }
reset = { position = { uniform = 0.05 } }

[[parameter]]
name = "pole_mass"
unit = "kg"
description = "mass of the pole"
edit = [{ body = "pole", field = "mass", by = "set" }]
bounds = [0.1, 5.0]
random = [0.4, 0.6]
extreme = [[0.2, 0.4], [0.6, 1.0]]
"#;
