//! MuJoCo simulations that environments share. Each thread has one simulation of each model. All environments of this
//! model that the thread runs use the simulation in turn.
//!
//! A model with MuJoCo's data takes 125 kB to some megabytes, but two environments differ only in some hundred bytes.
//! So shared simulations keep the memory of an environment small enough for the processor's caches. Environments do not
//! affect each other: before one runs, its edit of the model and its complete state are written into the simulation.

use perturb_mujoco::{Error, Model, Simulation};
use std::{any::Any, cell::RefCell, ptr, sync::Arc};

/// A compiled model, which is never modified, and the way in which an edit is applied to a simulation of it.
pub(super) trait SharedModel: Sync + 'static {
    /// An edit of the model: parameters, and the values in the model that follow from them.
    type Edit: Send + Sync + 'static;

    /// The compiled model, without edits.
    fn model(&self) -> &Model;

    /// Whether two edits result in the same model.
    fn is_same(a: &Self::Edit, b: &Self::Edit) -> bool;

    /// Applies an edit to the model of a simulation. `before` is the edit that is now applied to this model; `None`
    /// if that edit is not known.
    ///
    /// # Errors
    /// MuJoCo's fatal errors.
    fn write(&self, simulation: &mut Simulation, before: Option<&Self::Edit>, edit: &Self::Edit) -> Result<(), Error>;
}

/// A thread's simulation of a model, and the edit that is now applied to the simulation's model.
pub(super) struct Shared<T: SharedModel> {
    shared_model: &'static T,
    simulation: Simulation,
    edit: Option<Arc<T::Edit>>,
    /// A buffer for values that are read from the simulation.
    numbers: Vec<f64>,
}

/// A simulation that is not in use at the moment: the address of its [`SharedModel`], and its [`Shared`].
type Idle = (*const (), Box<dyn Any>);

thread_local! {
    static IDLE: RefCell<Vec<Idle>> = const { RefCell::new(Vec::new()) };
}

/// Runs `work` with this thread's simulation of the model. Creates the simulation at the first call, and again after a
/// fatal error.
///
/// # Errors
/// The errors of `work`, and [`Error::Fatal`] if there is not enough memory for a simulation.
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
    /// Returns the edit that is now applied, if `is_wanted` returns true for this edit. Otherwise calls `make`,
    /// which applies a new edit to the simulation and returns the new edit. The state of the simulation is undefined
    /// afterwards.
    ///
    /// # Errors
    /// The errors of `make`.
    pub(super) fn edit(
        &mut self,
        is_wanted: impl FnOnce(&T::Edit) -> bool,
        make: impl FnOnce(&'static T, &mut Simulation) -> Result<T::Edit, Error>,
    ) -> Result<Arc<T::Edit>, Error> {
        if let Some(edit) = self.edit.as_ref().filter(|edit| is_wanted(edit)) {
            return Ok(Arc::clone(edit));
        }
        self.edit = None; // the model is in no known state if `make` fails
        let edit = Arc::new(make(self.shared_model, &mut self.simulation)?);
        self.edit = Some(Arc::clone(&edit));
        Ok(edit)
    }

    /// Applies an edit, and returns the simulation with the edited model. The state of the simulation is undefined.
    ///
    /// # Errors
    /// MuJoCo's fatal errors.
    pub(super) fn edited(&mut self, edit: &Arc<T::Edit>) -> Result<&mut Simulation, Error> {
        let before = self.edit.as_ref();
        if !before.is_some_and(|before| Arc::ptr_eq(before, edit) || T::is_same(before, edit)) {
            self.shared_model.write(&mut self.simulation, before.map(|before| &**before), edit)?;
            self.edit = Some(Arc::clone(edit));
        }
        Ok(&mut self.simulation)
    }

    /// Applies an edit and sets this [state](Simulation::state). Returns the simulation and a buffer for values that
    /// are read from it. Poses and contacts of the state are not computed yet.
    ///
    /// # Errors
    /// MuJoCo's fatal errors.
    pub(super) fn at(&mut self, edit: &Arc<T::Edit>, state: &[f64]) -> Result<(&mut Simulation, &mut Vec<f64>), Error> {
        self.edited(edit)?.set_state(state)?;
        Ok((&mut self.simulation, &mut self.numbers))
    }
}
