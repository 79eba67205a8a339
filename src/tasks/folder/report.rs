//! The report about a folder that `perturb-server --check` prints.

use super::{
    effect,
    environment::{FolderTask, Poses},
    error::{Error, LoadError},
    files::Files,
    load::{TaskFolder, load},
    recompilation::Recompilation,
};
use crate::env::{
    Action, ActionSpec, ChannelSpec, DrawPurpose, EpisodeSettings, Episodes, ParameterSpec, PhiloxStream, Version,
};
use perturb_mujoco::ElementKind;
use std::{fmt::Write, path::Path, time::Duration};
use tokio::time::Instant;

/// Duration of the measurement of an environment's speed.
const TIMED: Duration = Duration::from_millis(200);
/// Number of compilations whose median time is reported.
const N_COMPILATIONS: u32 = 9;
/// Maximal number of names in a list of the report. Longer lists are shortened.
const MAX_LISTED: usize = 24;

impl TaskFolder {
    /// Returns the names of the parameters that have no visible effect in a short simulation from the initial state.
    ///
    /// # Errors
    /// [`Error`] if MuJoCo raises a fatal error.
    pub fn parameters_without_effect(&self) -> Result<Vec<&'static str>, Error> {
        effect::parameters_without_effect(self.task).map_err(Error::folder)
    }
}

/// Loads a folder and describes it: model, observations, actions, rewards, ends of episodes, parameters, memory, and
/// parameters without a visible effect. If `measured`, also measures and reports the speed.
///
/// # Errors
/// [`LoadError`] with the file, the line and what to do.
pub fn report(path: &Path, measured: bool) -> Result<String, LoadError> {
    let refuse = |error: Error| LoadError::new(path, error);
    let folder = load(path).map_err(refuse)?;
    let unseen = folder.parameters_without_effect().map_err(refuse)?;
    let trial = measured.then(|| try_steps(folder.task)).transpose();
    let trial = trial.map_err(|error| LoadError::new(path, error))?;
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = describe(&mut text, folder.task, folder.files, &unseen, trial);
    if let Some(recompilation) = &folder.task.template.recompilation {
        let time = measured.then(|| compilation_time(folder.task, recompilation)).transpose();
        let _ = lengths(&mut text, folder.task, recompilation, time.map_err(|error| LoadError::new(path, error))?);
    }
    Ok(text)
}

/// Writes the line about parameters that edit lengths: their names, the time of a compilation, and the memory of a
/// model.
fn lengths(
    out: &mut String,
    task: &FolderTask,
    recompilation: &Recompilation,
    time: Option<Duration>,
) -> std::fmt::Result {
    let names: Vec<&str> = recompilation.parameters(&task.parameters).collect();
    let kilobytes = task.template.model.model_bytes() / 1000;
    let time = time.map_or(String::new(), |time| format!(", {:.2} ms", 1e3 * time.as_secs_f64()));
    writeln!(
        out,
        "  lengths       {}: another value compiles the model again{time}, and an environment keeps {kilobytes} kB more",
        names.join(", ")
    )
}

/// Measures the median time to compile the model with edited lengths. The parameters are near the upper ends of version
/// E.
fn compilation_time(task: &FolderTask, recompilation: &Recompilation) -> Result<Duration, perturb_mujoco::Error> {
    let mut times = Vec::new();
    for i in 1..=N_COMPILATIONS {
        let share = 1.0 - f64::from(i) * 1e-6; // gives values that are not in the cache
        let value = |parameter: &ParameterSpec| {
            let high = parameter.extreme[1].high;
            parameter.default + share * (high - parameter.default)
        };
        let values: Vec<f64> = task.spec.parameters.iter().map(value).collect();
        let start = Instant::now();
        recompilation.model(&task.template.model, &values)?;
        times.push(start.elapsed());
    }
    times.sort_unstable();
    Ok(times[times.len() / 2])
}

/// Writes all of the report except the line about lengths.
fn describe(
    out: &mut String,
    task: &FolderTask,
    files: &Files,
    unseen: &[&str],
    trial: Option<Trial>,
) -> std::fmt::Result {
    let (spec, model) = (&task.spec, &task.template.model);
    let names: Vec<&str> = files.names().collect();
    writeln!(out, "{}: {}", spec.name, spec.description)?;
    writeln!(out, "  files         {} ({} kB): {}", names.len(), files.n_bytes() / 1000, shortened(&names))?;
    writeln!(out, "  hash          {}", task.hash)?;
    writeln!(
        out,
        "  model         {} bodies, {} joints, {} degrees of freedom, {} geoms, {} actuators, {} sensors",
        model.n_body() - 1,
        model.n_joint(),
        model.n_v(),
        model.n_geom(),
        model.n_u(),
        model.count(ElementKind::Sensor)
    )?;
    writeln!(
        out,
        "  step          {} timesteps of {} s, at most {} steps per episode; poses of bodies are {}",
        task.frame_skip,
        model.timestep(),
        spec.step_limit,
        if task.poses == Poses::Before { "those before the last timestep" } else { "those after the step" }
    )?;
    let channels =
        |channels: &[ChannelSpec]| shortened(&channels.iter().map(|channel| channel.name).collect::<Vec<_>>());
    writeln!(out, "  observation   {} numbers: {}", spec.observation.len(), channels(spec.observation))?;
    if let ActionSpec::Continuous(actions) = spec.action {
        writeln!(out, "  action        {} numbers: {}", actions.len(), channels(actions))?;
    }
    writeln!(out, "  exact state   {} numbers: {}", spec.state.len(), channels(spec.state))?;
    for term in spec.reward_terms {
        writeln!(out, "  reward        {}: {}", term.name, term.description)?;
    }
    let ends = match (task.healthy.len(), task.terminate_when_unhealthy) {
        (0, _) => "at the limit of steps",
        (_, true) => "when the robot is not healthy, or at the limit of steps",
        (_, false) => "at the limit of steps; when the robot is not healthy, the terms `healthy` change",
    };
    writeln!(out, "  episodes end  {ends}")?;
    writeln!(out, "  success       {}", spec.success.description)?;
    if spec.parameters.is_empty() {
        writeln!(out, "  parameters    none: versions D, R and E are the same")?;
    }
    let parameters = spec.parameters.iter().map(|parameter| ("parameter", parameter));
    let disturbances = task.disturbances.iter().map(|disturbance| ("disturbance", disturbance));
    for (kind, parameter) in parameters.chain(disturbances) {
        let [below, above] = parameter.extreme;
        writeln!(
            out,
            "  {kind:<13} {} ({}): D {}, R [{}, {}], E [{}, {}] and [{}, {}], within [{}, {}]: {}",
            parameter.name,
            parameter.unit,
            parameter.default,
            parameter.random.low,
            parameter.random.high,
            below.low,
            below.high,
            above.low,
            above.high,
            parameter.bounds.low,
            parameter.bounds.high,
            parameter.description
        )?;
    }
    for quantity in &task.applied {
        writeln!(out, "  receipts      also have {} ({})", quantity.quantity.name, quantity.quantity.unit)?;
    }
    if task.has_total_mass {
        writeln!(out, "  note          the model has settotalmass: an edited mass is not rescaled to that total")?;
    }
    writeln!(
        out,
        "  memory        at most {} kB per thread for the simulation; {} kB of it for the model",
        model.simulation_bytes() / 1000,
        model.model_bytes() / 1000
    )?;
    if let Some(Trial { steps_per_second, episodes, diverged }) = trial {
        writeln!(out, "  speed         {steps_per_second:.0} steps per second on one core")?;
        if diverged > 0 {
            writeln!(
                out,
                "  warning       the physics diverged in {diverged} of {episodes} episodes of random actions; try a smaller \
                 timestep"
            )?;
        }
    }
    for name in unseen {
        writeln!(
            out,
            "  warning       parameter {name}: 200 timesteps from the initial state are the same bytes at both ends of E; \
             it may have no effect"
        )?;
    }
    Ok(())
}

fn shortened(names: &[&str]) -> String {
    if names.len() <= MAX_LISTED {
        return names.join(", ");
    }
    format!("{}, …, {}", names[..MAX_LISTED - 1].join(", "), names[names.len() - 1])
}

/// The result of stepping an environment with random actions on version D.
struct Trial {
    steps_per_second: f64,
    /// Number of episodes that ended.
    episodes: u32,
    /// Number of episodes that ended because the physics diverged.
    diverged: u32,
}

/// Steps an environment with random actions for the time [`TIMED`].
fn try_steps(task: &'static FolderTask) -> Result<Trial, crate::env::Error> {
    let spec = &task.spec;
    let distributions = spec.distributions(Version::D).into();
    let settings = EpisodeSettings { seed: 0, environment_index: 0, distributions, episodes_per_trial: 1 };
    let mut episodes = Episodes::new((spec.make)()?, settings);
    let mut trial = Trial { steps_per_second: 0.0, episodes: 0, diverged: 0 };
    let ActionSpec::Continuous(channels) = spec.action else { return Ok(trial) };
    let mut stream = PhiloxStream::new(1, 0, DrawPurpose::InitialState, 0);
    let mut terms = vec![0.0; spec.reward_terms.len()];
    let mut action = vec![0.0; channels.len()];
    let (start, mut steps) = (Instant::now(), 0.0);
    while start.elapsed() < TIMED {
        for (value, channel) in action.iter_mut().zip(channels) {
            *value = stream.uniform(channel.low, channel.high) as f32;
        }
        episodes.step(Action::Continuous(&action), &mut terms);
        steps += 1.0;
        if episodes.ended() {
            trial.episodes += 1;
            trial.diverged += u32::from(episodes.finished(false).diverged);
            episodes.begin(None);
        }
    }
    trial.steps_per_second = steps / start.elapsed().as_secs_f64();
    Ok(trial)
}
