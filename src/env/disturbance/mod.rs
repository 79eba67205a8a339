//! Disturbances: actions that arrive late, are held, noisy or weak, and observations that are late, noisy or lost.
//! docs/disturbances.md has their laws.
//!
//! Every environment of a catalogue, built in or a folder, has a disturbed twin: the same environment with the
//! disturbances as further parameters, behind its own. A session whose requests name one of them opens the twin; all other
//! sessions are as if there were none. The twin is a layer between an episode and the physics:
//!
//! - `parameters` lists the disturbances of an environment.
//! - `layer` is the twin's environment: it passes actions by `actions` to the physics, and observations by `sensors` back.
//! - `changes` has the physics, which may change within an episode.

mod actions;
mod changes;
mod layer;
mod parameters;
mod sensors;

use super::{Environment, EnvironmentSpec, Error, Parameter, Quantity, shorten};
use layer::Disturbed;
use parameters::DisturbanceSet;
use std::sync::{Mutex, OnceLock, PoisonError};

/// An environment and its disturbed twin. Both live as long as the process.
#[derive(Clone, Copy)]
struct Twin {
    base: &'static EnvironmentSpec,
    disturbed: &'static EnvironmentSpec,
    disturbances: &'static [Parameter],
}

/// The disturbed twins that were made so far, at most one of each environment.
static TWINS: Mutex<Vec<Twin>> = Mutex::new(Vec::new());

/// Returns the disturbances that an environment can have besides its own parameters.
pub fn disturbances(spec: &'static EnvironmentSpec) -> &'static [Parameter] {
    twin(spec).disturbances
}

/// The disturbances that an environment could have, as parameters: all but those whose names it uses itself.
pub fn possible(spec: &EnvironmentSpec) -> Vec<Parameter> {
    DisturbanceSet::new(spec).parameters().collect()
}

/// The environment whose sessions all have the disturbances as further parameters, as a catalogue has it: with the sets of
/// `declared` in versions R and E. It has no disturbances beside its parameters, and is its own twin.
pub fn declare(spec: &'static EnvironmentSpec, declared: &[Parameter]) -> &'static EnvironmentSpec {
    let mut set = DisturbanceSet::new(spec);
    set.declare(declared);
    let disturbed = with_set(spec, set);
    let twin = Twin { base: disturbed, disturbed, disturbances: &[] };
    TWINS.lock().unwrap_or_else(PoisonError::into_inner).push(twin);
    disturbed
}

/// Returns the disturbed twin of an environment, which has the disturbances as further parameters.
pub fn disturbed(spec: &'static EnvironmentSpec) -> &'static EnvironmentSpec {
    twin(spec).disturbed
}

/// Returns the environment without disturbances: `spec` itself, or the environment whose disturbed twin it is.
pub fn undisturbed(spec: &EnvironmentSpec) -> &EnvironmentSpec {
    let twins = TWINS.lock().unwrap_or_else(PoisonError::into_inner);
    twins.iter().find(|twin| std::ptr::eq(twin.disturbed, spec)).map_or(spec, |twin| twin.base)
}

/// Returns the environment that has the parameters of these names: `spec` itself, or its disturbed twin if one of them
/// names a disturbance.
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
            let list = |parameters: &[Parameter]| parameters.iter().map(|p| p.name).collect::<Vec<_>>().join(", ");
            let known = format!("{}; and the disturbances {}", list(spec.parameters), list(disturbances));
            return Err(Error::UnknownParameter { environment: spec.name, name: shorten(name), known });
        }
        found = disturbed(spec);
    }
    Ok(found)
}

/// Checks that the environment of an open session has the parameters of these names.
///
/// # Errors
/// [`Error::UnknownParameter`], or [`Error::NotDisturbed`] for a disturbance that only the disturbed twin has.
pub fn check_open<'a>(spec: &'static EnvironmentSpec, names: impl IntoIterator<Item = &'a str>) -> Result<(), Error> {
    for name in names {
        if !std::ptr::eq(with_parameters(spec, [name])?, spec) {
            return Err(Error::NotDisturbed { environment: spec.name, name: name.into() });
        }
    }
    Ok(())
}

/// Returns an environment with its disturbed twin, which is made at the first call. `spec` may be either of the two.
fn twin(spec: &'static EnvironmentSpec) -> Twin {
    let mut twins = TWINS.lock().unwrap_or_else(PoisonError::into_inner);
    let is_known = |twin: &&Twin| std::ptr::eq(twin.base, spec) || std::ptr::eq(twin.disturbed, spec);
    if let Some(twin) = twins.iter().find(is_known) {
        return *twin;
    }
    let set = DisturbanceSet::new(spec);
    let disturbances: &'static [Parameter] = Vec::leak(set.parameters().collect());
    let twin = Twin { base: spec, disturbed: with_set(spec, set), disturbances };
    twins.push(twin);
    twin
}

/// The environment with these disturbances behind its own parameters.
fn with_set(spec: &'static EnvironmentSpec, set: DisturbanceSet) -> &'static EnvironmentSpec {
    let set: &'static DisturbanceSet = Box::leak(Box::new(set));
    let quantities = set.parameters().map(|Parameter { name, unit, .. }| Quantity { name, unit });
    let mut disturbed = *spec;
    disturbed.parameters = Vec::leak(spec.parameters.iter().copied().chain(set.parameters()).collect());
    disturbed.applied = Vec::leak(spec.applied.iter().copied().chain(quantities).collect());
    // Each environment refers to its spec, and the spec holds the closure that makes environments. The cell closes this
    // circle: the closure reads the spec's address from it.
    let address: &'static OnceLock<&'static EnvironmentSpec> = Box::leak(Box::default());
    disturbed.make = Box::leak(Box::new(move || {
        let disturbed = address.get().expect("nobody has the closure before the address is set");
        Ok(Box::new(Disturbed::new((spec.make)()?, disturbed, set)) as Box<dyn Environment>)
    }));
    address.get_or_init(|| Box::leak(Box::new(disturbed)))
}

/// The place after `place` in a ring of `length` numbers with entries of `width`. A remainder would cost a division a step.
fn next_place(place: usize, width: usize, length: usize) -> usize {
    let next = place + width;
    if next < length { next } else { 0 }
}
