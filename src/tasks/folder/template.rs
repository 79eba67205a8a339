//! The compiled model of a folder, and how parameters edit it.

use super::{parameter::EditedParameter, recompilation::Recompilation, target::Target};
use crate::tasks::shared;
use perturb_mujoco::{Error, Model, ModelField, Simulation};
use std::sync::Arc;

/// The compiled model of a folder, which is never modified, and the data for editing simulations of it.
#[derive(Debug)]
pub(super) struct Template {
    pub(super) model: Arc<Model>,
    /// The model's initial [state](Simulation::state).
    pub(super) state: Vec<f64>,
    /// The fields that the parameters edit, and the fields that MuJoCo derives from them.
    fields: Vec<ModelField>,
    /// The edits of lengths; `None` if no parameter edits a length.
    pub(super) recompilation: Option<Recompilation>,
    /// Whether MuJoCo must compute derived fields after an edit.
    derives: bool,
    /// The indices in [`ModelField::Statistic`] of the numbers that the model's text sets, which edits must not change.
    statistic: Vec<usize>,
}

/// An edit of the model: the parameters, and the fields of the model that follow from them.
#[derive(Debug)]
pub(super) struct ModelEdit {
    /// The values of the parameters, in order.
    pub(super) values: Box<[f64]>,
    /// The model, compiled with the lengths that the parameters `values` give, but without other edits.
    pub(super) compiled: Arc<Model>,
    fields: Box<[f64]>,
}

impl Template {
    /// Creates a template of a compiled model. `statistic` has the names of the attributes that the text's
    /// `<statistic>` sets.
    ///
    /// # Errors
    /// [`Error::Fatal`] if there is not enough memory.
    pub(super) fn new(model: Model, statistic: &[String]) -> Result<Self, Error> {
        let mut state = vec![0.0; model.n_state()];
        Simulation::new(model.try_clone()?)?.state(&mut state);
        let given = |name: &str| statistic.iter().any(|given| given == name);
        let names = ["meaninertia", "meanmass", "meansize", "extent", "center", "center", "center"];
        let statistic = (0..names.len()).filter(|&i| given(names[i])).collect();
        let model = Arc::new(model);
        Ok(Self { model, state, fields: Vec::new(), recompilation: None, derives: false, statistic })
    }

    /// Prepares the template for edits by these parameters. Call this method once, before the first edit.
    pub(super) fn prepare(&mut self, parameters: &[EditedParameter], recompilation: Option<Recompilation>) {
        self.recompilation = recompilation;
        let edited = || parameters.iter().flat_map(EditedParameter::targets);
        let targets = || edited().filter(|target| !target.is_recompiled());
        self.derives = targets().any(Target::changes_constants);
        let derived = if self.derives { &ModelField::DERIVED[..] } else { &[] };
        self.fields.clear();
        for field in targets().flat_map(Target::fields).chain(derived.iter().copied()) {
            if !self.fields.contains(&field) {
                self.fields.push(field);
            }
        }
    }

    /// Returns the model, compiled with the lengths that the parameters `values` give.
    fn compiled(&self, values: &[f64]) -> Result<Arc<Model>, Error> {
        match &self.recompilation {
            None => Ok(Arc::clone(&self.model)),
            Some(recompilation) => recompilation.model(&self.model, values),
        }
    }
}

impl Template {
    /// Returns the edit for the parameters `values`, computed by this thread's simulation.
    ///
    /// # Errors
    /// MuJoCo's fatal errors, and [`Error::Compile`] if the model cannot be compiled with the lengths that `values`
    /// give.
    pub(super) fn edit(&'static self, parameters: &[EditedParameter], values: &[f64]) -> Result<Arc<ModelEdit>, Error> {
        shared::with(self, |shared| {
            shared.edit(
                |edit| is_same(&edit.values, values),
                |own, simulation| own.new_edit(simulation, parameters, values),
            )
        })
    }

    fn new_edit(
        &self,
        simulation: &mut Simulation,
        parameters: &[EditedParameter],
        values: &[f64],
    ) -> Result<ModelEdit, Error> {
        let compiled = self.compiled(values)?;
        if self.recompilation.is_some() {
            simulation.set_model(&compiled)?;
        }
        let pristine = &*compiled;
        for &field in &self.fields {
            simulation.field_mut(field).copy_from_slice(pristine.field(field));
        }
        let is_pristine =
            parameters.iter().zip(values).all(|(parameter, &value)| parameter.is_pristine(pristine, value));
        if !is_pristine {
            for (parameter, &value) in parameters.iter().zip(values) {
                parameter.apply(pristine, simulation, value);
            }
            if self.derives {
                simulation.set_const()?;
                for &entry in &self.statistic {
                    simulation.field_mut(ModelField::Statistic)[entry] = pristine.field(ModelField::Statistic)[entry];
                }
            }
        }
        let mut fields = vec![0.0; pristine.n_fields(&self.fields)].into_boxed_slice();
        simulation.fields(&self.fields, &mut fields);
        Ok(ModelEdit { values: values.into(), compiled, fields })
    }
}

impl shared::SharedModel for Template {
    type Edit = ModelEdit;

    fn model(&self) -> &Model {
        &self.model
    }

    fn is_same(a: &ModelEdit, b: &ModelEdit) -> bool {
        is_same(&a.values, &b.values)
    }

    fn write(&self, simulation: &mut Simulation, before: Option<&ModelEdit>, edit: &ModelEdit) -> Result<(), Error> {
        let has_lengths = before.is_some_and(|before| Arc::ptr_eq(&before.compiled, &edit.compiled));
        if self.recompilation.is_some() && !has_lengths {
            simulation.set_model(&edit.compiled)?;
        }
        simulation.set_fields(&self.fields, &edit.fields);
        Ok(())
    }
}

/// Whether two lists of values are equal bit for bit. 0 and -0 differ, because they result in different models.
fn is_same(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}
