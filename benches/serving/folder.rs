//! The cost of tasks that are loaded from folders, compared with the built-in Hopper and with only the calls of
//! MuJoCo's functions.
//!
//! - `step/folder/Hopper`: the built-in Hopper's model as a folder with similar reward terms, compared with the
//!   built-in task. Measures the steps per second of 64 environments, on one server with two workers.
//! - `step/folder/Walker2d`, `Ant` and `Humanoid`: Gymnasium's tasks with 64 environments. Compares the server's CPU
//!   time with a bare loop that makes the same number of calls to MuJoCo's functions: mj_step, and mj_rnePostConstraint
//!   if contact forces are read.
//! - `step/folder/lengths`: Walker2d on version R (random) with 64 environments. Compares a thigh length that is drawn
//!   at each reset with a fixed length. Also measures the memory that each environment takes.
//!
//! All measurements except the first need Gymnasium's models, in the folder that the environment variable
//! `PERTURB_TEST_GYMNASIUM_ASSETS` names.

use crate::{
    Failure,
    client::{Client, SEED, ServerProcess, width},
    median,
    robots::{process_cpu, thread_cpu},
};
use bytes::Bytes;
use perturb::{
    env::{Action, Distribution, EnvironmentSpec, EpisodeSettings, Episodes, ParameterSpec, Version},
    tasks::folder,
};
use perturb_mujoco::{Model, Simulation};
use std::{fs, path::Path, time::Instant};
use tempfile::TempDir;

const BATCH: usize = 64;
const ROUNDS: usize = 11;
/// Returns the number of environment steps in a round. It depends on the estimated cost of a step, because with the
/// same number for all environments, Humanoid's round would take three seconds.
fn steps_of_a_round(spec: &EnvironmentSpec) -> usize {
    const ROUND_US: f64 = 500_000.0;
    ((ROUND_US / spec.step_cost) as usize / BATCH).clamp(16, 128) * BATCH
}

/// The built-in Hopper's task as a `task.toml`, as far as the format allows: roboschool's reward terms, and the
/// observation without the clipping of single elements.
const HOPPER: &str = r#"
format = 1
name = "FolderHopper"
description = "Hop forward on one leg."
model = "hopper.xml"
frame_skip = 4
step_limit = 1000
poses = "after"
observation = [
  { body = "torso", get = "com", axes = "z", clip = 5.0 },
  { body = "torso", get = "velocity", scale = 0.3, clip = 5.0 },
  { body = "torso", get = "roll", clip = 5.0 },
  { body = "torso", get = "pitch", clip = 5.0 },
  { joint = ["thigh", "leg", "foot"], get = "scaled", clip = 5.0 },
  { joint = ["thigh", "leg", "foot"], get = "velocity", scale = 0.1, clip = 5.0 },
]
reward = [
  { name = "alive", healthy = 1.0, otherwise = -1.0 },
  { name = "progress", rate = { com = "*", axes = "x" } },
  { name = "electricity", power = { actuator = "*" }, weight = -0.2, mean = true },
  { name = "stall_torque", squared = { action = "*" }, weight = -0.1, mean = true },
  { name = "joint_limits", limits = { joint = ["thigh", "leg", "foot"] }, weight = -0.2 },
]
healthy = [
  { of = { body = "torso", get = "com", axes = "z" }, above = 0.8 },
  { of = { body = "torso", get = "pitch" }, above = -1.0, below = 1.0 },
]
success = { description = "the torso came 20 m far", greatest = { body = "torso", get = "com", axes = "x" }, quantity = "distance", at_least = 20.0 }
actions = { range = [-1.0, 1.0] }
reset = { joints = [{ joint = ["thigh", "leg", "foot"], position = { uniform = 0.1 } }] }
"#;

/// Gymnasium's tasks that are measured: the name, the name of the task file, and whether contact forces are read.
const GYMNASIUM: [(&str, &str, bool); 3] =
    [("Walker2d", "walker2d_v5", false), ("Ant", "ant_v5", true), ("Humanoid", "humanoid_v5", true)];

/// Returns the ids of all measurements.
pub(crate) fn ids() -> impl Iterator<Item = String> {
    std::iter::once("Hopper")
        .chain(GYMNASIUM.map(|(name, ..)| name))
        .chain(["lengths"])
        .map(|name| format!("step/folder/{name}"))
}

/// Makes the measurement `id` and prints its results.
pub(crate) async fn served(id: &str) -> Result<(), Failure> {
    let name = id.rsplit('/').next().unwrap_or_default();
    if name == "Hopper" {
        return beside_the_built_in(id).await;
    }
    let Some(assets) = std::env::var_os("PERTURB_TEST_GYMNASIUM_ASSETS") else {
        println!("{id:<22} not measured: PERTURB_TEST_GYMNASIUM_ASSETS does not name gymnasium's envs/mujoco/assets");
        return Ok(());
    };
    let read = |file: &str| -> Result<(String, String, String), Failure> {
        let text = fs::read_to_string(format!("python/src/perturb/task_files/{file}.toml"))?;
        let model =
            text.split("model = \"").nth(1).and_then(|rest| rest.split('"').next()).ok_or("no model")?.to_owned();
        let mjcf = fs::read_to_string(Path::new(&assets).join(&model))?;
        Ok((text, model, mjcf))
    };
    if name == "lengths" {
        let (text, model, mjcf) = read("walker2d_v5")?;
        return with_lengths(id, written(&(text + LENGTH), &model, &mjcf)?.path()).await;
    }
    for (task, file, external_forces) in GYMNASIUM {
        if task == name {
            let (text, model, mjcf) = read(file)?;
            let folder = written(&text, &model, &mjcf)?;
            beside_mujoco(id, folder.path(), &mjcf, external_forces).await?;
        }
    }
    Ok(())
}

/// A parameter for Walker2d's task file: the length of its thighs.
const LENGTH: &str = r#"
[[parameter]]
name = "thigh_length"
unit = "m"
description = "length of both thighs, whose mass follows"
edit = [{ body = ["thigh", "thigh_left"], field = "length", by = "set" }]
bounds = [0.2, 0.8]
random = [0.4, 0.5]
extreme = [[0.3, 0.4], [0.5, 0.6]]
"#;

async fn with_lengths(id: &str, path: &Path) -> Result<(), Failure> {
    const TRIPS: usize = 64;
    const MORE: usize = 1024;
    let spec = folder::load(path)?.spec();
    let server = ServerProcess::with_flags(2, &["--task".as_ref(), path])?;
    let distributions = |is_drawn: bool| -> Vec<(&str, Distribution)> {
        let of = |parameter: &ParameterSpec| match parameter.name {
            "thigh_length" if !is_drawn => Distribution::fixed(parameter.default),
            _ => parameter.distribution(Version::R),
        };
        spec.parameters.iter().map(|parameter| (parameter.name, of(parameter))).collect()
    };
    let mut fixed = Client::open_drawn(&server.socket, spec, BATCH, &distributions(false)).await?;
    let mut drawn = Client::open_drawn(&server.socket, spec, BATCH, &distributions(true)).await?;
    let (mut ratios, mut steps) = (Vec::new(), Vec::new());
    for _ in 0..2 * ROUNDS {
        let expected = TRIPS as f64 / fixed.run(TRIPS).await?;
        let found = TRIPS as f64 / drawn.run(TRIPS).await?;
        ratios.push(found / expected);
        steps.push(found * BATCH as f64);
    }
    println!("{id:<22} {:>8.0} env steps/s with a length that is drawn at each reset", median(&mut steps));
    println!("{id:<22} {:>8.3} of those with a fixed length", median(&mut ratios));
    for (is_drawn, about) in [(false, "a fixed length"), (true, "its own length")] {
        let before = server.resident()?;
        let mut many = Client::open_drawn(&server.socket, spec, MORE, &distributions(is_drawn)).await?;
        many.run(5).await?;
        let each = (server.resident()? - before) / 1e3 / MORE as f64;
        println!("{id:<22} {each:>8.1} kB of the server for each environment with {about}");
    }
    Ok(())
}

fn written(task: &str, model: &str, mjcf: &str) -> Result<TempDir, Failure> {
    let folder = tempfile::tempdir()?;
    fs::write(folder.path().join("task.toml"), task)?;
    fs::write(folder.path().join(model), mjcf)?;
    Ok(folder)
}

async fn beside_the_built_in(id: &str) -> Result<(), Failure> {
    const TRIPS: usize = 128;
    let folder = written(HOPPER, "hopper.xml", include_str!("../../models/hopper.xml"))?;
    let own = folder::load(folder.path())?.spec();
    let server = ServerProcess::with_flags(2, &["--task".as_ref(), folder.path()])?;
    let mut built_in = Client::open(&server.socket, "Hopper", BATCH).await?;
    let mut from_folder = Client::open_spec(&server.socket, own, BATCH).await?;
    let (mut ratios, mut steps) = (Vec::new(), Vec::new());
    for _ in 0..2 * ROUNDS {
        let expected = TRIPS as f64 / built_in.run(TRIPS).await?;
        let found = TRIPS as f64 / from_folder.run(TRIPS).await?;
        ratios.push(found / expected);
        steps.push(found * BATCH as f64);
    }
    println!("{id:<22} {:>8.0} env steps/s", median(&mut steps));
    println!("{id:<22} {:>8.3} of the built-in one's steps/s (at least 0.9)", median(&mut ratios));
    Ok(())
}

async fn beside_mujoco(id: &str, path: &Path, mjcf: &str, external_forces: bool) -> Result<(), Failure> {
    let spec = folder::load(path)?.spec();
    let server = ServerProcess::with_flags(1, &["--task".as_ref(), path])?;
    let mut client = Client::open_spec(&server.socket, spec, BATCH).await?;
    let before = server.resident()?;
    let mut bare = Bare::new(spec, mjcf, external_forces)?;
    let (mut served_ratios, mut own_ratios, mut micros) = (Vec::new(), Vec::new(), Vec::new());
    let steps = steps_of_a_round(spec);
    for _ in 0..ROUNDS {
        let actions: Vec<Bytes> = (0..steps / BATCH).map(|_| client.actions()).collect();
        let own = bare.environments(&actions)?;
        let mujoco = bare.run(&actions)?;
        let cpu = process_cpu(&server.proc())?;
        client.play(&actions, 1).await?;
        let served = process_cpu(&server.proc())? - cpu;
        served_ratios.push(served / mujoco);
        own_ratios.push(own / mujoco);
        micros.push(mujoco * 1e6 / steps as f64);
    }
    println!("{id:<22} {:>8.2} us of CPU time an env step in the bare loop", median(&mut micros));
    println!("{id:<22} {:>8.3} of it in the server (at most 1.10)", median(&mut served_ratios));
    println!("{id:<22} {:>8.3} of it without the server, in this process", median(&mut own_ratios));
    let more = 1024;
    let mut many = Client::open_spec(&server.socket, spec, more).await?;
    many.run(5).await?;
    println!(
        "{id:<22} {:>8.1} kB of the server for each environment (at most 8)",
        (server.resident()? - before) / 1e3 / more as f64
    );
    Ok(())
}

/// The start of an environment's round: the state before the round, and a list of the episodes that began in the round.
/// An episode is given by the number of the round's steps before it, and by its initial state.
type RoundStart = (Vec<f64>, Vec<(usize, Vec<f64>)>);

/// Environments in this process, with the same seed as the server's environments, and a simulation that repeats only
/// their physics.
struct Bare {
    spec: &'static EnvironmentSpec,
    episodes: Vec<Episodes>,
    simulation: Simulation,
    starts: Vec<RoundStart>,
    n_substeps: usize,
    external_forces: bool,
}

impl Bare {
    fn new(spec: &'static EnvironmentSpec, mjcf: &str, external_forces: bool) -> Result<Self, Failure> {
        let episodes = (0..BATCH as u32)
            .map(|environment_index| {
                let distributions = spec.distributions(Version::D).into();
                let settings = EpisodeSettings { seed: SEED, environment_index, distributions, episodes_per_trial: 1 };
                Ok(Episodes::new((spec.make)()?, settings))
            })
            .collect::<Result<Vec<_>, Failure>>()?;
        let simulation = Simulation::new(Model::from_xml(mjcf)?)?;
        let n_substeps = (spec.control_timestep / simulation.model().timestep()).round() as usize;
        Ok(Self { spec, episodes, simulation, starts: Vec::new(), n_substeps, external_forces })
    }

    fn state(&self, i: usize) -> Vec<f64> {
        let n = self.simulation.model().n_state();
        // The first element is the flag of divergence. MuJoCo's state follows.
        self.episodes[i].physics_state()[1..=n].to_vec()
    }

    /// Steps the environments without a server. Returns the CPU time, in s.
    fn environments(&mut self, actions: &[Bytes]) -> Result<f64, Failure> {
        let n = width(self.spec);
        let mut terms = vec![0.0; self.spec.reward_terms.len()];
        self.starts = (0..BATCH).map(|i| (self.state(i), Vec::new())).collect();
        let this = Path::new("/proc/thread-self");
        let (start, mut apart) = (thread_cpu(this)?, 0.0);
        for (t, action) in actions.iter().enumerate() {
            let floats: Vec<f32> = action.as_chunks::<4>().0.iter().map(|x| f32::from_le_bytes(*x)).collect();
            for i in 0..BATCH {
                self.episodes[i].step(Action::Continuous(&floats[i * n..][..n]), &mut terms);
                if self.episodes[i].ended() {
                    self.episodes[i].begin(None);
                    let recording = Instant::now();
                    let state = self.state(i);
                    self.starts[i].1.push((t + 1, state));
                    apart += recording.elapsed().as_secs_f64();
                }
            }
        }
        Ok(thread_cpu(this)? - start - apart)
    }

    /// Repeats only the physics of the last call of [`Bare::environments`], one environment after the other. Returns
    /// the CPU time, in s.
    fn run(&mut self, actions: &[Bytes]) -> Result<f64, Failure> {
        let n = width(self.spec);
        let this = Path::new("/proc/thread-self");
        let start = thread_cpu(this)?;
        for (i, (state, episodes)) in self.starts.iter().enumerate() {
            self.simulation.set_state(state)?;
            let mut next = episodes.iter();
            let mut begins = next.next();
            for (t, action) in actions.iter().enumerate() {
                if let Some((_, state)) = begins.filter(|(at, _)| *at == t) {
                    self.simulation.set_state(state)?;
                    begins = next.next();
                }
                let floats = &action.as_chunks::<4>().0[i * n..][..n];
                for (ctrl, a) in self.simulation.ctrl_mut().iter_mut().zip(floats) {
                    *ctrl = f32::from_le_bytes(*a).into();
                }
                for _ in 0..self.n_substeps {
                    self.simulation.step()?;
                }
                if self.external_forces {
                    self.simulation.external_forces()?;
                }
            }
        }
        Ok(thread_cpu(this)? - start)
    }
}
