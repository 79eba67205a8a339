//! Parameters at the end of an observation, for policies that observe them.

use super::{Environment, EnvironmentSpec, Parameter};

/// The parameters of one environment as they are observed.
pub(super) struct SeenParameters {
    /// Each parameter with the position of its quantity in [`EnvironmentSpec::applied`].
    parameters: Vec<(&'static Parameter, usize)>,
    /// Buffer for the values of [`EnvironmentSpec::applied`].
    applied: Vec<f64>,
    /// The entries, one for each parameter.
    entries: Vec<f32>,
}

impl SeenParameters {
    /// Reads the parameters that an environment has now.
    pub(super) fn new(environment: &dyn Environment) -> Self {
        let EnvironmentSpec { parameters, applied, .. } = environment.spec();
        let place = |parameter: &'static Parameter| {
            let place = applied.iter().position(|quantity| quantity.name == parameter.applied);
            (parameter, place.expect("every parameter is read back; a test checks each"))
        };
        let mut seen = Self {
            parameters: parameters.iter().map(place).collect(),
            applied: vec![0.0; applied.len()],
            entries: vec![0.0; parameters.len()],
        };
        seen.read(environment);
        seen
    }

    /// Reads the parameters back from the physics, after they were set.
    pub(super) fn read(&mut self, environment: &dyn Environment) {
        environment.applied(&mut self.applied);
        for (entry, (parameter, place)) in self.entries.iter_mut().zip(&self.parameters) {
            *entry = parameter.observed(self.applied[*place]);
        }
    }

    /// Returns the entries, one for each parameter.
    pub(super) fn entries(&self) -> &[f32] {
        &self.entries
    }
}
