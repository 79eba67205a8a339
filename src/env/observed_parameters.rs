//! Observed parameters: the entries that a client may request at the end of each observation.

use super::{Environment, EnvironmentSpec, ParameterSpec};

/// The current parameters of one environment, scaled for observations.
pub(super) struct ObservedParameters {
    /// Each parameter, and the index in [`EnvironmentSpec::applied`] of the quantity that reads the parameter back.
    parameters: Vec<(&'static ParameterSpec, usize)>,
    /// A buffer for the values of [`EnvironmentSpec::applied`].
    applied: Vec<f64>,
    /// The observed entries, one for each parameter.
    entries: Vec<f32>,
}

impl ObservedParameters {
    /// Reads the current parameters of an environment.
    pub(super) fn new(environment: &dyn Environment) -> Self {
        let EnvironmentSpec { parameters, applied, .. } = environment.spec();
        let place = |parameter: &'static ParameterSpec| {
            let place = applied.iter().position(|quantity| quantity.name == parameter.applied);
            (parameter, place.expect("every parameter is read back; a test checks each"))
        };
        let mut observed = Self {
            parameters: parameters.iter().map(place).collect(),
            applied: vec![0.0; applied.len()],
            entries: vec![0.0; parameters.len()],
        };
        observed.read(environment);
        observed
    }

    /// Updates the entries from the physics. Call this method after the environment's parameters were set.
    pub(super) fn read(&mut self, environment: &dyn Environment) {
        environment.applied(&mut self.applied);
        for (entry, (parameter, place)) in self.entries.iter_mut().zip(&self.parameters) {
            *entry = parameter.observed(self.applied[*place]);
        }
    }

    /// Returns the observed entries, one for each parameter.
    pub(super) fn entries(&self) -> &[f32] {
        &self.entries
    }
}
