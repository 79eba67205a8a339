//! Physics that change within an episode: between the environment's parameters and those after a change.

use super::parameters::DisturbanceValues;
use crate::env::{Draw, Environment, Error, Purpose, Stream};

/// An environment whose physics have one of two sets of parameters.
pub(super) struct ChangingPhysics {
    pub(super) environment: Box<dyn Environment>,
    /// Whether the physics can change.
    is_changing: bool,
    /// Whether the second set is in force.
    is_changed: bool,
    /// The parameters before and after a change, `[2, P]`.
    sets: [Vec<f64>; 2],
    /// The values that the physics have with each set, `[2, applied]`.
    applied: [Vec<f64>; 2],
    /// The place among them of the quantity that reads each parameter back.
    places: Vec<usize>,
    /// The state that goes over from one set to the other.
    state: Vec<f64>,
}

impl ChangingPhysics {
    /// The physics of an environment that has its default parameters.
    pub(super) fn new(environment: Box<dyn Environment>) -> Self {
        let spec = environment.spec();
        let place = |name: &str| spec.applied.iter().position(|quantity| quantity.name == name);
        let places = spec.parameters.iter().map(|parameter| place(parameter.applied));
        let places = places.map(|place| place.expect("every parameter is read back; a test checks each")).collect();
        let sets = [(); 2].map(|()| vec![0.0; spec.parameters.len()]);
        let applied = [(); 2].map(|()| vec![0.0; spec.applied.len()]);
        Self { environment, is_changing: false, is_changed: false, sets, applied, places, state: Vec::new() }
    }

    /// Takes the parameters before and after a change, and reads both back from the physics, if they can change.
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

    /// Writes what the physics have before a change.
    pub(super) fn applied(&self, out: &mut [f64]) {
        if self.is_changing { out.copy_from_slice(&self.applied[0]) } else { self.environment.applied(out) }
    }

    /// Returns what the physics have of a parameter after a change; `None` if they cannot change.
    pub(super) fn changed(&self, parameter: usize) -> Option<f64> {
        self.is_changing.then(|| self.applied[1][self.places[parameter]])
    }

    /// Returns to the parameters before a change. The state is undefined afterwards.
    pub(super) fn begin(&mut self) {
        if self.is_changed {
            self.is_changed = false;
            self.environment.set_parameters(&self.sets[0]);
        }
    }

    /// Changes the physics if this step begins with a change. The state goes over.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if the changed physics refuse the state, which is undefined then.
    pub(super) fn pass(&mut self, values: &DisturbanceValues, draw: &Draw, step: u32) -> Result<(), Error> {
        if !(self.is_changing && begins_with_change(values, draw, step)) {
            return Ok(());
        }
        self.state.clear();
        self.environment.save(&mut self.state);
        self.is_changed = !self.is_changed;
        self.environment.set_parameters(&self.sets[usize::from(self.is_changed)]);
        self.environment.load(&self.state)
    }

    /// Appends the state of the physics, then whether they are changed.
    pub(super) fn save(&self, out: &mut Vec<f64>) {
        self.environment.save(out);
        out.push(f64::from(u8::from(self.is_changed)));
    }

    /// Restores the state that [`save`](Self::save) wrote.
    ///
    /// # Errors
    /// [`Error::Snapshot`]; the state is undefined then.
    pub(super) fn load(&mut self, saved: &[f64]) -> Result<(), Error> {
        let (own, is_changed) = match saved {
            [own @ .., 0.0] => (own, false),
            [own @ .., 1.0] if self.is_changing => (own, true),
            _ => return Err(Error::Snapshot { reason: "it does not tell whether its physics are changed".into() }),
        };
        if is_changed != self.is_changed {
            self.is_changed = is_changed;
            self.environment.set_parameters(&self.sets[usize::from(is_changed)]);
        }
        self.environment.load(own)
    }
}

/// Whether the physics change between step number `step` and the one before.
fn begins_with_change(values: &DisturbanceValues, draw: &Draw, step: u32) -> bool {
    let DisturbanceValues { change_at, change_every, change_probability, .. } = *values;
    let is_drawn =
        || change_probability > 0.0 && Stream::at_step(draw, Purpose::Change, step).unit() < change_probability;
    step > 0 && (step == change_at || (change_every > 0 && step.is_multiple_of(change_every)) || is_drawn())
}
