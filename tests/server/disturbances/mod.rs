//! Disturbances: their laws, what they do not change, and sessions with them.

mod changes;
mod echo;
mod environments;
mod laws;
#[cfg(feature = "mujoco")]
mod pushes;
mod sessions;

use perturb::env::{
    Distribution, EnvironmentSpec, EpisodeSettings, Episodes, ParameterSpec, Version, disturbance, resolve,
};

/// Returns settings of a disturbed environment: a version, and these values of parameters.
fn settings(
    spec: &'static EnvironmentSpec,
    version: Version,
    values: &[(&str, f64)],
    (seed, environment_index): (u64, u32),
) -> EpisodeSettings {
    let spec = disturbance::disturbed(spec);
    let mut distributions = spec.distributions(version);
    resolve(spec, &mut distributions, values.iter().map(|&(name, value)| (name, Distribution::fixed(value)))).unwrap();
    EpisodeSettings { seed, environment_index, distributions: distributions.into(), episodes_per_trial: 1 }
}

/// Returns a disturbed environment, with a version and these values of parameters, at the start of its first episode.
fn disturbed(
    spec: &'static EnvironmentSpec,
    version: Version,
    values: &[(&str, f64)],
    address: (u64, u32),
) -> Episodes {
    Episodes::new((disturbance::disturbed(spec).make)().unwrap(), settings(spec, version, values, address))
}

/// Returns a value with an effect for each disturbance that the environment supports.
fn all(spec: &'static EnvironmentSpec) -> Vec<(&'static str, f64)> {
    let value = |parameter: &ParameterSpec| match parameter.name {
        "action_delay" => 3.0,
        "sensor_delay" => 2.0,
        "action_scale" => 0.8,
        "push_interval" => 10.0,
        name if name.starts_with("action_scale_") => 0.9,
        "action_noise" | "sensor_noise" => 0.05,
        "change_at" => 5.0,
        "change_every" => 13.0,
        name if name.starts_with("changed_") => 0.5 * (parameter.random.low + parameter.random.high),
        _ => 0.1,
    };
    disturbance::disturbances(spec).iter().map(|parameter| (parameter.name, value(parameter))).collect()
}
