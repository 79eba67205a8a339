//! Disturbances: delayed, repeated, noisy or scaled actions; delayed, noisy or lost observations; pushes; and physics
//! that change within an episode. docs/disturbances.md defines them.
//!
//! Every environment has a disturbed twin: the same environment with the disturbances appended to its parameters. A
//! session opens the twin if its request names a disturbance. Other sessions open the environment itself, and are not
//! affected. The twin wraps the environment:
//!
//! - `parameters` defines the disturbances of an environment and their values.
//! - `layer` is the twin. It passes actions through `actions` to the physics, and observations through `sensors` back.
//! - `noise` draws the random numbers of noise, also ahead of the step.
//! - `changes` holds the physics, which may change within an episode.

mod actions;
mod changes;
mod layer;
mod noise;
mod parameters;
mod sensors;

use super::{Distribution, Environment, EnvironmentSpec, Error, ParameterSpec, QuantitySpec, shorten};
use layer::Disturbed;
use parameters::DisturbanceSet;
use std::sync::{Mutex, OnceLock, PoisonError};

/// An environment and its disturbed twin, which has the disturbances as additional parameters. Both live as long as the
/// process.
#[derive(Clone, Copy)]
struct Twin {
    base: &'static EnvironmentSpec,
    disturbed: &'static EnvironmentSpec,
    disturbances: &'static [ParameterSpec],
}

/// The disturbed twins that were created so far, at most one for each environment.
static TWINS: Mutex<Vec<Twin>> = Mutex::new(Vec::new());

/// Returns the disturbances that an environment can have in addition to its own parameters.
pub fn disturbances(spec: &'static EnvironmentSpec) -> &'static [ParameterSpec] {
    twin(spec).disturbances
}

/// Returns all disturbances that suit an environment, as parameters. Leaves out names that the environment itself uses
/// for a parameter or quantity.
pub fn possible(spec: &EnvironmentSpec) -> Vec<ParameterSpec> {
    DisturbanceSet::new(spec).parameters().collect()
}

/// Makes an environment whose own parameters include all disturbances. A parameter in `declared` replaces the
/// disturbance of the same name, so that versions R and E can draw other values than the default. The environment is
/// its own disturbed twin.
pub fn declare(spec: &'static EnvironmentSpec, declared: &[ParameterSpec]) -> &'static EnvironmentSpec {
    let mut set = DisturbanceSet::new(spec);
    set.declare(declared);
    let disturbed = with_set(spec, set);
    let twin = Twin { base: disturbed, disturbed, disturbances: &[] };
    TWINS.lock().unwrap_or_else(PoisonError::into_inner).push(twin);
    disturbed
}

/// Returns the disturbed twin of an environment, which has the disturbances as additional parameters.
pub fn disturbed(spec: &'static EnvironmentSpec) -> &'static EnvironmentSpec {
    twin(spec).disturbed
}

/// Returns the original environment if `spec` is a disturbed twin, otherwise `spec` itself.
pub fn undisturbed(spec: &EnvironmentSpec) -> &EnvironmentSpec {
    let twins = TWINS.lock().unwrap_or_else(PoisonError::into_inner);
    twins.iter().find(|twin| std::ptr::eq(twin.disturbed, spec)).map_or(spec, |twin| twin.base)
}

/// Whether environments with these distributions have noisy actions or observations. `distributions` has the layout of
/// [`EpisodeSettings::distributions`](super::EpisodeSettings::distributions).
pub fn has_noise(spec: &EnvironmentSpec, distributions: &[Distribution]) -> bool {
    let mut parameters = spec.parameters.iter().cycle().zip(distributions);
    parameters.any(|(parameter, distribution)| {
        parameters::NOISE_PARAMETERS.contains(&parameter.name) && distribution.fixed_value() != Some(0.0)
    })
}

/// Returns the environment that has parameters with these names: the disturbed twin if one of the names is a
/// disturbance, otherwise `spec` itself.
///
/// # Errors
/// [`Error::UnknownParameter`] for a name that is neither a parameter nor a disturbance.
pub fn with_parameters<'a>(
    spec: &'static EnvironmentSpec,
    names: impl IntoIterator<Item = &'a str>,
) -> Result<&'static EnvironmentSpec, Error> {
    let mut found = spec;
    for name in names {
        if spec.parameters.iter().any(|parameter| parameter.name == name) {
            continue;
        }
        let disturbances = disturbances(spec);
        if !disturbances.iter().any(|disturbance| disturbance.name == name) {
            let list = |parameters: &[ParameterSpec]| parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", ");
            let known = format!("{}; and the disturbances {}", list(spec.parameters), list(disturbances));
            return Err(Error::UnknownParameter { environment: spec.name, name: shorten(name), known });
        }
        found = disturbed(spec);
    }
    Ok(found)
}

/// Checks that `spec`, the environment of an open session, has parameters with these names.
///
/// # Errors
/// [`Error::NotDisturbed`] for a disturbance that only the disturbed twin has, [`Error::UnknownParameter`] for other
/// names.
pub fn check_open<'a>(spec: &'static EnvironmentSpec, names: impl IntoIterator<Item = &'a str>) -> Result<(), Error> {
    for name in names {
        if !std::ptr::eq(with_parameters(spec, [name])?, spec) {
            return Err(Error::NotDisturbed { environment: spec.name, name: name.into() });
        }
    }
    Ok(())
}

/// Returns an environment and its disturbed twin, which is created at the first call. `spec` may be either of the two.
fn twin(spec: &'static EnvironmentSpec) -> Twin {
    let mut twins = TWINS.lock().unwrap_or_else(PoisonError::into_inner);
    let is_known = |twin: &&Twin| std::ptr::eq(twin.base, spec) || std::ptr::eq(twin.disturbed, spec);
    if let Some(twin) = twins.iter().find(is_known) {
        return *twin;
    }
    let set = DisturbanceSet::new(spec);
    let disturbances: &'static [ParameterSpec] = Vec::leak(set.parameters().collect());
    let twin = Twin { base: spec, disturbed: with_set(spec, set), disturbances };
    twins.push(twin);
    twin
}

/// Makes an environment with the disturbances in `set` appended to its own parameters.
fn with_set(spec: &'static EnvironmentSpec, set: DisturbanceSet) -> &'static EnvironmentSpec {
    let set: &'static DisturbanceSet = Box::leak(Box::new(set));
    let quantities = set.parameters().map(|ParameterSpec { name, unit, .. }| QuantitySpec { name, unit });
    let mut disturbed = *spec;
    disturbed.parameters = Vec::leak(spec.parameters.iter().copied().chain(set.parameters()).collect());
    disturbed.applied = Vec::leak(spec.applied.iter().copied().chain(quantities).collect());
    // An environment refers to its spec, and the spec holds the closure that creates the environment. The cell breaks
    // this cycle: it is filled with the spec's address below, and the closure reads the address from it.
    let address: &'static OnceLock<&'static EnvironmentSpec> = Box::leak(Box::default());
    disturbed.make = Box::leak(Box::new(move || {
        let disturbed = address.get().expect("nobody has the closure before the address is set");
        Ok(Box::new(Disturbed::new((spec.make)()?, disturbed, set)) as Box<dyn Environment>)
    }));
    address.get_or_init(|| Box::leak(Box::new(disturbed)))
}

/// Returns the offset of the entry that follows the entry at `offset`, in a ring buffer of `length` numbers with
/// entries of `width` numbers. A comparison is used, because a remainder would cost a division in each step.
fn next_offset(offset: usize, width: usize, length: usize) -> usize {
    let next = offset + width;
    if next < length { next } else { 0 }
}

/// Returns the nearest finite f32. NaN stays NaN.
#[inline]
fn finite(number: f64) -> f32 {
    number.clamp(f32::MIN.into(), f32::MAX.into()) as f32
}
