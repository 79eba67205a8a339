//! Physics that change within an episode, between two sets of parameters.

use super::parameters::DisturbanceValues;
use crate::env::{Draw, DrawPurpose, Environment, Error, PhiloxStream};

/// An environment whose physics may switch between two sets of parameters: the normal set and the changed set.
pub(super) struct ChangingPhysics {
    pub(super) environment: Box<dyn Environment>,
    /// Whether the physics can change within an episode.
    is_changing: bool,
    /// Whether the physics have the changed set now.
    is_changed: bool,
    /// The parameters of the normal set and of the changed set.
    sets: [Vec<f64>; 2],
    /// The quantities of `EnvironmentSpec::applied` with the normal set and with the changed set.
    applied: [Vec<f64>; 2],
    /// For each parameter, the index in `EnvironmentSpec::applied` of the quantity that reads the parameter back.
    applied_indices: Vec<usize>,
    /// A buffer for the state of the physics during a change.
    state: Vec<f64>,
}

impl ChangingPhysics {
    /// Wraps an environment that has its default parameters.
    pub(super) fn new(environment: Box<dyn Environment>) -> Self {
        let spec = environment.spec();
        let place = |name: &str| spec.applied.iter().position(|quantity| quantity.name == name);
        let applied_indices = spec.parameters.iter().map(|parameter| place(parameter.applied));
        let applied_indices =
            applied_indices.map(|place| place.expect("every parameter is read back; a test checks each")).collect();
        let sets = [(); 2].map(|()| vec![0.0; spec.parameters.len()]);
        let applied = [(); 2].map(|()| vec![0.0; spec.applied.len()]);
        Self { environment, is_changing: false, is_changed: false, sets, applied, applied_indices, state: Vec::new() }
    }

    /// Applies the normal parameters `own`. If the physics can change, also stores `own` and the changed parameters
    /// `values.changed`, and reads the quantities of both sets back from the physics. The state is undefined until the
    /// next reset.
    pub(super) fn set_parameters(&mut self, own: &[f64], values: &DisturbanceValues) {
        self.is_changing = values.is_changing();
        self.is_changed = false;
        if self.is_changing {
            self.sets[0].copy_from_slice(own);
            self.sets[1].copy_from_slice(&values.changed);
            for (set, applied) in self.sets.iter().zip(&mut self.applied).rev() {
                self.environment.set_parameters(set);
                self.environment.applied(applied);
            }
        } else {
            self.environment.set_parameters(own);
        }
    }

    /// Writes the quantities of `EnvironmentSpec::applied` for the normal set to `out`.
    pub(super) fn applied(&self, out: &mut [f64]) {
        if self.is_changing { out.copy_from_slice(&self.applied[0]) } else { self.environment.applied(out) }
    }

    /// Returns the value that the parameter with index `parameter` has in the changed set, read back from the physics.
    /// Returns `None` if the physics cannot change.
    pub(super) fn changed(&self, parameter: usize) -> Option<f64> {
        self.is_changing.then(|| self.applied[1][self.applied_indices[parameter]])
    }

    /// Prepares a new episode: applies the normal parameters if the physics have the changed set. The state is then
    /// undefined until the next reset.
    pub(super) fn begin(&mut self) {
        if self.is_changed {
            self.is_changed = false;
            self.environment.set_parameters(&self.sets[0]);
        }
    }

    /// Switches to the other set of parameters if there is a change before step number `step`. The state stays the
    /// same. Returns false if the state is not valid with the other parameters, and is therefore undefined.
    #[inline]
    pub(super) fn apply(&mut self, values: &DisturbanceValues, draw: &Draw, step: u32) -> bool {
        !self.is_changing || !begins_with_change(values, draw, step) || self.switch().is_ok()
    }

    fn switch(&mut self) -> Result<(), Error> {
        self.state.clear();
        self.environment.save(&mut self.state);
        self.is_changed = !self.is_changed;
        self.environment.set_parameters(&self.sets[usize::from(self.is_changed)]);
        self.environment.load(&self.state)
    }

    /// Appends the state of the physics, then 1 if they have the changed set, otherwise 0.
    pub(super) fn save(&self, out: &mut Vec<f64>) {
        self.environment.save(out);
        out.push(f64::from(u8::from(self.is_changed)));
    }

    /// Restores a state that [`save`](Self::save) appended.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the state is not valid. After an error, the state is undefined.
    pub(super) fn load(&mut self, saved: &[f64]) -> Result<(), Error> {
        let (own, is_changed) = match saved {
            [own @ .., 0.0] => (own, false),
            [own @ .., 1.0] if self.is_changing => (own, true),
            _ => {
                let reason = "its mark of changed physics is missing, or does not fit its parameters".into();
                return Err(Error::Snapshot { reason });
            }
        };
        if is_changed != self.is_changed {
            self.is_changed = is_changed;
            self.environment.set_parameters(&self.sets[usize::from(is_changed)]);
        }
        self.environment.load(own)
    }
}

/// Whether the physics change just before step number `step`, counted from 0. The physics never change before step 0.
fn begins_with_change(values: &DisturbanceValues, draw: &Draw, step: u32) -> bool {
    let DisturbanceValues { change_at, change_every, change_probability, .. } = *values;
    let is_drawn = || {
        change_probability > 0.0 && PhiloxStream::at_step(draw, DrawPurpose::Change, step).unit() < change_probability
    };
    step > 0 && (step == change_at || (change_every > 0 && step.is_multiple_of(change_every)) || is_drawn())
}
