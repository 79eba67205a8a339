//! The simulations that environments take turns in. Each thread has one simulation of each model.
//!
//! A model with MuJoCo's data takes 129 kB to some megabytes, but the difference between two environments is some hundred
//! bytes. Environments of so few bytes stay in the caches. An environment cannot see what another one did: its edit of the
//! model and its whole state are written into the simulation before it runs.

use perturb_mujoco::{Error, Model, Simulation};
use std::{any::Any, cell::RefCell, ptr, sync::Arc};

/// A compiled model, which nothing changes, and the way in which edits change copies of it.
pub(super) trait SharedModel: Sync + 'static {
    /// A change of the model: parameters, and what comes of them.
    type Edit: Send + Sync + 'static;

    /// The compiled model.
    fn model(&self) -> &Model;

    /// Tells whether two edits make the same model.
    fn is_same(a: &Self::Edit, b: &Self::Edit) -> bool;

    /// Writes the edited model into a simulation that has the model of the edit `before`, or none that is known.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    fn write(&self, simulation: &mut Simulation, before: Option<&Self::Edit>, edit: &Self::Edit) -> Result<(), Error>;
}

/// A simulation, and the last edit of its model.
pub(super) struct Shared<T: SharedModel> {
    shared_model: &'static T,
    simulation: Simulation,
    edit: Option<Arc<T::Edit>>,
    /// Scratch for readings.
    numbers: Vec<f64>,
}

/// A simulation that is not in use at the moment: its model's address, and a [`Shared`].
type Idle = (*const (), Box<dyn Any>);

thread_local! {
    static IDLE: RefCell<Vec<Idle>> = const { RefCell::new(Vec::new()) };
}

/// Runs `work` with this thread's simulation of the model, which is made when it is first needed and after a fatal error.
///
/// # Errors
/// Those of `work`, and [`Error::Fatal`] without memory for a simulation.
pub(super) fn with<T: SharedModel, R>(
    shared_model: &'static T,
    work: impl FnOnce(&mut Shared<T>) -> Result<R, Error>,
) -> Result<R, Error> {
    let address = ptr::from_ref(shared_model).cast();
    let idle = IDLE.with_borrow_mut(|idle| {
        let place = idle.iter().position(|(of, _)| *of == address)?;
        idle.swap_remove(place).1.downcast::<Shared<T>>().ok()
    });
    let mut shared = match idle {
        Some(shared) => shared,
        None => {
            let simulation = Simulation::new(shared_model.model().try_clone()?)?;
            Box::new(Shared { shared_model, simulation, edit: None, numbers: Vec::new() })
        }
    };
    let result = work(&mut shared);
    if !shared.simulation.is_poisoned() {
        IDLE.with_borrow_mut(|idle| idle.push((address, shared)));
    }
    result
}

impl<T: SharedModel> Shared<T> {
    /// The last edit, if `is_wanted`, or else a new one, which `make` writes into the simulation. The state is undefined
    /// afterwards.
    ///
    /// # Errors
    /// Those of `make`.
    pub(super) fn edit(
        &mut self,
        is_wanted: impl FnOnce(&T::Edit) -> bool,
        make: impl FnOnce(&'static T, &mut Simulation) -> Result<T::Edit, Error>,
    ) -> Result<Arc<T::Edit>, Error> {
        if let Some(edit) = self.edit.as_ref().filter(|edit| is_wanted(edit)) {
            return Ok(Arc::clone(edit));
        }
        self.edit = None; // `make` may fail half-way
        let edit = Arc::new(make(self.shared_model, &mut self.simulation)?);
        self.edit = Some(Arc::clone(&edit));
        Ok(edit)
    }

    /// The simulation with the edited model. Its state is undefined.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn edited(&mut self, edit: &Arc<T::Edit>) -> Result<&mut Simulation, Error> {
        let before = self.edit.as_ref();
        if !before.is_some_and(|before| Arc::ptr_eq(before, edit) || T::is_same(before, edit)) {
            self.shared_model.write(&mut self.simulation, before.map(|before| &**before), edit)?;
            self.edit = Some(Arc::clone(edit));
        }
        Ok(&mut self.simulation)
    }

    /// The simulation with the edited model in this [state](Simulation::state), from which nothing is computed yet, and
    /// the scratch for readings.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn at(&mut self, edit: &Arc<T::Edit>, state: &[f64]) -> Result<(&mut Simulation, &mut Vec<f64>), Error> {
        self.edited(edit)?.set_state(state)?;
        Ok((&mut self.simulation, &mut self.numbers))
    }
}
