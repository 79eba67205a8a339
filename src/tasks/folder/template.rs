//! The compiled model of a folder, its edits, and the simulations that environments share.

use super::parameter::EditedParameter;
use perturb_mujoco::{Error, Field, Model, Simulation};
use std::{cell::RefCell, ptr, sync::Arc};

thread_local! {
    /// The simulations of this thread that are not in use.
    static IDLE: RefCell<Vec<SharedSimulation>> = const { RefCell::new(Vec::new()) };
}

/// A compiled model, which nothing changes.
#[derive(Debug)]
pub(super) struct Template {
    pub(super) model: Model,
    /// The initial [state](Simulation::state), `[n_state]`.
    pub(super) state: Vec<f64>,
    /// The fields that edits change, and the fields that are derived from these.
    fields: Vec<Field>,
    /// The contents of `fields` in the pristine model.
    pristine: Vec<f64>,
    /// Whether derived fields must be computed after an edit.
    derives: bool,
    /// The entries of [`Field::Statistic`] that the model's text gives.
    statistic: Vec<usize>,
}

/// A change of the model: the parameters, and the fields that result from them.
#[derive(Debug)]
pub(super) struct ModelEdit {
    /// The parameters, `[P]`.
    pub(super) values: Box<[f64]>,
    fields: Box<[f64]>,
}

impl Template {
    /// Makes a template of a compiled model. `statistic` names the attributes of the text's `<statistic>`.
    ///
    /// # Errors
    /// [`Error::Fatal`] without memory.
    pub(super) fn new(model: Model, statistic: &[String]) -> Result<Self, Error> {
        let mut state = vec![0.0; model.n_state()];
        Simulation::new(model.try_clone()?)?.state(&mut state);
        let given = |name: &str| statistic.iter().any(|given| given == name);
        let names = ["meaninertia", "meanmass", "meansize", "extent", "center", "center", "center"];
        let statistic = (0..names.len()).filter(|&i| given(names[i])).collect();
        Ok(Self { model, state, fields: Vec::new(), pristine: Vec::new(), derives: false, statistic })
    }

    /// Prepares the template for edits by these parameters.
    pub(super) fn prepare(&mut self, parameters: &[EditedParameter]) {
        let targets = || parameters.iter().flat_map(EditedParameter::targets);
        self.derives = targets().any(super::target::Target::changes_constants);
        let derived = if self.derives { &Field::DERIVED[..] } else { &[] };
        self.fields.clear();
        for field in targets().flat_map(super::target::Target::fields).chain(derived.iter().copied()) {
            if !self.fields.contains(&field) {
                self.fields.push(field);
            }
        }
        self.pristine = self.fields.iter().flat_map(|&field| self.model.field(field)).copied().collect();
    }
}

/// A simulation of a thread, which environments take turns in, and the edit that its model was last given.
///
/// A model with MuJoCo's data takes megabytes, but two environments differ in some hundred bytes. An environment cannot
/// see what another one did: its whole state is written into the simulation before it runs.
pub(super) struct SharedSimulation {
    template: &'static Template,
    simulation: Simulation,
    edit: Option<Arc<ModelEdit>>,
    /// A scratch buffer for readings.
    pub(super) numbers: Vec<f64>,
}

/// Runs `work` with this thread's simulation of the model. It is made when it is first needed, and again after a fatal
/// error.
///
/// # Errors
/// Those of `work`, and [`Error::Fatal`] without memory for a simulation.
pub(super) fn with<T>(
    template: &'static Template,
    work: impl FnOnce(&mut SharedSimulation) -> Result<T, Error>,
) -> Result<T, Error> {
    let idle = IDLE.with_borrow_mut(|idle| {
        let place = idle.iter().position(|shared| ptr::eq(shared.template, template))?;
        Some(idle.swap_remove(place))
    });
    let mut shared = match idle {
        Some(shared) => shared,
        None => {
            let simulation = Simulation::new(template.model.try_clone()?)?;
            SharedSimulation { template, simulation, edit: None, numbers: Vec::new() }
        }
    };
    let result = work(&mut shared);
    if !shared.simulation.is_poisoned() {
        IDLE.with_borrow_mut(|idle| idle.push(shared));
    }
    result
}

impl SharedSimulation {
    /// Makes the edit for these parameter values. The state is undefined afterwards.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn edit(&mut self, parameters: &[EditedParameter], values: &[f64]) -> Result<Arc<ModelEdit>, Error> {
        if let Some(edit) = self.edit.as_ref().filter(|edit| is_same(&edit.values, values)) {
            return Ok(Arc::clone(edit));
        }
        let Self { template, simulation, .. } = self;
        self.edit = None;
        simulation.set_fields(&template.fields, &template.pristine);
        let pristine = &template.model;
        let is_pristine =
            parameters.iter().zip(values).all(|(parameter, &value)| parameter.is_pristine(pristine, value));
        if !is_pristine {
            for (parameter, &value) in parameters.iter().zip(values) {
                parameter.apply(pristine, simulation, value);
            }
            if template.derives {
                simulation.set_const()?;
                for &entry in &template.statistic {
                    simulation.field_mut(Field::Statistic)[entry] = pristine.field(Field::Statistic)[entry];
                }
            }
        }
        let mut fields = vec![0.0; template.pristine.len()].into_boxed_slice();
        simulation.fields(&template.fields, &mut fields);
        let edit = Arc::new(ModelEdit { values: values.into(), fields });
        self.edit = Some(Arc::clone(&edit));
        Ok(edit)
    }

    /// Returns the simulation with the edited model. Its state is undefined.
    pub(super) fn edited(&mut self, edit: &Arc<ModelEdit>) -> &mut Simulation {
        let is_in_force =
            self.edit.as_ref().is_some_and(|own| Arc::ptr_eq(own, edit) || is_same(&own.values, &edit.values));
        if !is_in_force {
            self.simulation.set_fields(&self.template.fields, &edit.fields);
            self.edit = Some(Arc::clone(edit));
        }
        &mut self.simulation
    }

    /// Returns the simulation with the edited model in this [state](Simulation::state), and the scratch buffer for
    /// readings. Nothing is computed from the state yet.
    ///
    /// # Errors
    /// MuJoCo's fatal ones.
    pub(super) fn at(
        &mut self,
        edit: &Arc<ModelEdit>,
        state: &[f64],
    ) -> Result<(&mut Simulation, &mut Vec<f64>), Error> {
        self.edited(edit).set_state(state)?;
        Ok((&mut self.simulation, &mut self.numbers))
    }
}

/// Whether values are the same bit for bit, because 0 and -0 make different models.
fn is_same(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}
