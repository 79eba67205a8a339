//! Compiles a model again with edited lengths, and caches the compiled models.

use super::{
    error::Result,
    lengths::{EditedLength, EditedText},
    mjcf::{Mjcf, escaped_reason},
    parameter::EditedParameter,
    table::TomlTable,
};
use perturb_mujoco::{Error, Model};
use std::{
    collections::{HashMap, VecDeque},
    sync::{Arc, Mutex, PoisonError},
};

/// Maximal size of a model whose lengths are edited, in bytes. The limit is low, because each environment may need its
/// own compiled model.
const MAX_MODEL_BYTES: usize = 1 << 20;
/// Maximal total size of the cached models of a task, in bytes.
const MAX_CACHE_BYTES: usize = 8 << 20;
/// Maximal number of cached models of a task.
const MAX_CACHED: usize = 1024;

/// The texts of a model whose lengths can be edited, and a cache of compiled models.
#[derive(Debug)]
pub(super) struct Recompilation {
    edited_lengths: Vec<EditedLength>,
    physics: EditedText,
    picture: EditedText,
    files: Vec<(String, Vec<u8>)>,
    cache: Mutex<CompiledModels>,
}

#[derive(Debug, Default)]
struct CompiledModels {
    /// The compiled models. The key has the bits of [`EditedLength::amount`] for each edited length.
    models: HashMap<Box<[u64]>, Arc<Model>>,
    /// The keys of `models`, oldest first.
    order: VecDeque<Box<[u64]>>,
}

impl Recompilation {
    /// Prepares the edits of lengths. Returns `None` if no parameter edits a length. As a check, compiles the model
    /// with each such parameter at the ends of its bounds and of its intervals in R and E.
    ///
    /// # Errors
    /// [`super::Error`] with the parameter and the value, if the text cannot be edited or the model cannot be compiled.
    pub(super) fn new(
        tables: &[TomlTable<'_>],
        parameters: &[EditedParameter],
        mjcf: &Mjcf,
        model: &Model,
    ) -> Result<Option<Self>> {
        let edited_lengths = EditedLength::all(parameters, model);
        let error = |parameter: usize, problem: String| {
            let name = parameters[parameter].parameter.name;
            tables[parameter].clone().at(format!("parameter {name}")).error(problem)
        };
        let Some(first) = edited_lengths.first() else { return Ok(None) };
        if model.model_bytes() > MAX_MODEL_BYTES {
            let (own, most) = (model.model_bytes() / 1000, MAX_MODEL_BYTES / 1000);
            return Err(error(
                first.parameter,
                format!("the model takes {own} kB, and each environment would have its own; the limit is {most} kB"),
            ));
        }
        let refuse =
            |length_index: usize, problem: &str| error(edited_lengths[length_index].parameter, problem.to_owned());
        let physics = EditedText::new(&mjcf.physics, model, &edited_lengths, mjcf.lacks_visual_geoms, &refuse)?;
        let picture = EditedText::new(&mjcf.picture, model, &edited_lengths, mjcf.lacks_visual_geoms, &refuse)?;
        let own = Self { edited_lengths, physics, picture, files: mjcf.physics.files.clone(), cache: Mutex::default() };
        // The model is compiled with extreme values, so that impossible lengths are found when the folder is loaded.
        let defaults: Vec<f64> = parameters.iter().map(|edited| edited.parameter.default).collect();
        for (i, parameter) in parameters.iter().map(|edited| &edited.parameter).enumerate() {
            if own.edited_lengths.iter().all(|edited_length| edited_length.parameter != i) {
                continue;
            }
            let [below, above] = parameter.extreme;
            for value in [parameter.bounds, parameter.random, below, above].map(|set| [set.low, set.high]).concat() {
                let mut values = defaults.clone();
                values[i] = value;
                own.compile(model, &own.amounts(&values)).map_err(|failure| {
                    let said = match failure {
                        Error::Compile { reason } => escaped_reason(&reason),
                        other => other.to_string(),
                    };
                    error(i, format!("with {value} MuJoCo 2.2.2 says: {said}; narrow the bounds"))
                })?;
            }
        }
        Ok(Some(own))
    }

    /// Returns the names of the parameters that edit lengths.
    pub(super) fn parameters<'a>(
        &'a self,
        parameters: &'a [EditedParameter],
    ) -> impl Iterator<Item = &'static str> + 'a {
        let is_own = |i: usize| self.edited_lengths.iter().any(|edited_length| edited_length.parameter == i);
        parameters.iter().enumerate().filter(move |(i, _)| is_own(*i)).map(|(_, edited)| edited.parameter.name)
    }

    fn amounts(&self, values: &[f64]) -> Vec<f64> {
        self.edited_lengths.iter().map(|edited_length| edited_length.amount(values)).collect()
    }

    fn is_neutral(&self, amounts: &[f64]) -> bool {
        self.edited_lengths
            .iter()
            .zip(amounts)
            .all(|(edited_length, amount)| amount.to_bits() == edited_length.neutral().to_bits())
    }

    /// Returns the model with the lengths that the parameters `values` give, from the cache if possible. If no length
    /// differs from the unedited model, returns `own`, the unedited model.
    ///
    /// # Errors
    /// [`Error::Compile`] if the model cannot be compiled with these lengths.
    pub(super) fn model(&self, own: &Arc<Model>, values: &[f64]) -> std::result::Result<Arc<Model>, Error> {
        let amounts = self.amounts(values);
        if self.is_neutral(&amounts) {
            return Ok(Arc::clone(own));
        }
        let key: Box<[u64]> = amounts.iter().map(|amount| amount.to_bits()).collect();
        // A poisoned mutex is harmless, since no panic can leave the cache in a bad state.
        let lock = || self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = lock().models.get(&key) {
            return Ok(Arc::clone(found));
        }
        let model = Arc::new(self.compile(own, &amounts)?);
        let capacity = (MAX_CACHE_BYTES / model.model_bytes()).clamp(1, MAX_CACHED);
        let mut cache = lock();
        if cache.models.insert(key.clone(), Arc::clone(&model)).is_none() {
            cache.order.push_back(key);
        }
        while cache.order.len() > capacity {
            let oldest = cache.order.pop_front().unwrap_or_default();
            cache.models.remove(&oldest);
        }
        Ok(model)
    }

    /// Returns the MJCF for pictures with the lengths that the parameters `values` give; `None` if no length differs
    /// from the unedited model.
    pub(super) fn picture(&self, values: &[f64]) -> Option<String> {
        let amounts = self.amounts(values);
        (!self.is_neutral(&amounts)).then(|| self.picture.write(&self.edited_lengths, &amounts))
    }

    fn compile(&self, own: &Model, amounts: &[f64]) -> std::result::Result<Model, Error> {
        let files: Vec<(&str, &[u8])> =
            self.files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect();
        let model = Model::from_files(&self.physics.write(&self.edited_lengths, amounts), &files)?;
        if model.has_sizes_of(own) {
            return Ok(model);
        }
        Err(Error::Compile {
            reason: "the edited model has other numbers of elements than the model in the folder".into(),
        })
    }
}
