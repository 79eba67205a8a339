//! The dictionaries `info` and `infos`. They are filled here, column by column: made of Python's objects they took longer
//! than the steps of the environments.
//!
//! A reset's info has, if receipts were asked for:
//!
//! - `parameters`: what was drawn or given, by name;
//! - `receipt`: which episode this is (`environment_index`, `trial_index`, `episode_index`), `applied`, the values read
//!   back from the physics, by name, and `model_hash`;
//! - `context_id`: the trial's index, which counts the draws of parameters.
//!
//! The info of an episode's last step has these too, `is_success` and `diverged`, and `achieved` unless there is nothing:
//! the value of the quantity that the rule of success compares. Every step's has `reward_terms`, if they were asked for.
//! Nothing in them depends on the clock.
//!
//! Of a batch, each key holds an array `[N]`, and the key with an underscore before it a mask of the environments that have
//! it, as `VectorEnv._add_info` of Gymnasium makes them.

use std::sync::Arc;

use bytes::Bytes;
use numpy::{Element, PyArray1, PyArrayMethods, PyReadonlyArray1};
use perturb_protocol::proto;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};

use crate::arrays;
use crate::failure::{MALFORMED, failure};

/// A key, and that of the mask of the environments that have it.
struct Label {
    key: Py<PyString>,
    mask: Py<PyString>,
}

impl Label {
    fn new(py: Python<'_>, name: &str) -> Self {
        Self { key: PyString::new(py, name).unbind(), mask: PyString::new(py, &format!("_{name}")).unbind() }
    }
}

/// What a session's infos call their values, made once.
pub struct Labels {
    /// N.
    num_envs: usize,
    parameters: Vec<Label>,
    applied: Vec<Label>,
    reward_terms: Vec<Label>,
    known: Known,
}

macro_rules! known {
    ($($name:ident),*) => {
        /// The keys that are the same for all environments.
        struct Known { $($name: Label),* }

        impl Known {
            fn new(py: Python<'_>) -> Self {
                Self { $($name: Label::new(py, stringify!($name))),* }
            }
        }
    };
}

known! {
    is_success, diverged, achieved, context_id, parameters, receipt, applied, environment_index, trial_index,
    episode_index, model_hash, reward_terms, final_obs, final_info
}

impl Labels {
    /// Those of an environment of which there are N.
    pub fn new(py: Python<'_>, environment: &proto::Environment, num_envs: usize) -> Self {
        Self {
            num_envs,
            parameters: environment.parameters.iter().map(|it| Label::new(py, &it.name)).collect(),
            applied: environment.applied.iter().map(|it| Label::new(py, &it.name)).collect(),
            reward_terms: environment.reward_terms.iter().map(|it| Label::new(py, &it.name)).collect(),
            known: Known::new(py),
        }
    }
}

/// What began and ended in a request.
#[pyclass(frozen, module = "perturb._native")]
pub struct Events {
    labels: Arc<Labels>,
    ended: Vec<proto::EpisodeEnd>,
    started: Vec<proto::EpisodeStart>,
    final_observations: Vec<f32>,
    /// O.
    observation_size: usize,
    reward_terms: Vec<f32>,
}

/// An episode with its receipt.
type Told<'a> = (usize, &'a proto::Episode, &'a proto::Receipt);

impl Events {
    /// Episodes that began.
    ///
    /// # Errors
    /// If they do not fit.
    pub fn begun(labels: &Arc<Labels>, started: Vec<proto::EpisodeStart>) -> PyResult<Self> {
        Self {
            labels: Arc::clone(labels),
            ended: Vec::new(),
            started,
            final_observations: Vec::new(),
            observation_size: 0,
            reward_terms: Vec::new(),
        }
        .checked()
    }

    /// Those of a step; `None` if nothing began or ended, and no reward terms came.
    ///
    /// # Errors
    /// If they do not fit.
    pub fn stepped(labels: &Arc<Labels>, stepped: proto::Stepped, observation_size: usize) -> PyResult<Option<Self>> {
        let proto::Stepped { ended, started, final_observations, reward_terms, .. } = stepped;
        if ended.is_empty() && started.is_empty() && reward_terms.is_empty() {
            return Ok(None);
        }
        let terms = |bytes: &Bytes| match bytes.is_empty() {
            true => Ok(Vec::new()),
            false => arrays::numbers(bytes, &[labels.num_envs, labels.reward_terms.len()]),
        };
        Self {
            labels: Arc::clone(labels),
            final_observations: arrays::numbers(&final_observations, &[ended.len(), observation_size])?,
            reward_terms: terms(&reward_terms)?,
            ended,
            started,
            observation_size,
        }
        .checked()
        .map(Some)
    }

    /// The episodes that ended.
    pub fn ended(&self) -> &[proto::EpisodeEnd] {
        &self.ended
    }

    fn checked(self) -> PyResult<Self> {
        let slots = self.ended.iter().map(|end| end.slot).chain(self.started.iter().map(|start| start.slot));
        let receipts = self.ended.iter().map(|end| &end.receipt).chain(self.started.iter().map(|start| &start.receipt));
        let (n, labels) = (self.labels.num_envs, &self.labels);
        let fits = |receipt: &proto::Receipt| {
            receipt.requested.len() == labels.parameters.len() && receipt.applied.len() == labels.applied.len()
        };
        if slots.max().is_some_and(|most| most as usize >= n) || !receipts.flatten().all(fits) {
            let words =
                format!("the server sent episodes that do not fit a batch of {n}, or receipts of other lengths");
            return Err(failure(MALFORMED, 0, words));
        }
        Ok(self)
    }
}

#[pymethods]
impl Events {
    /// Infos of one environment by itself.
    fn single<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (info, known) = (PyDict::new(py), &self.labels.known);
        if !self.reward_terms.is_empty() {
            let named = PyDict::new(py);
            for (label, &term) in self.labels.reward_terms.iter().zip(&self.reward_terms) {
                named.set_item(&label.key, term)?;
            }
            info.set_item(&known.reward_terms.key, named)?;
        }
        if let Some(end) = self.ended.first() {
            info.set_item(&known.is_success.key, end.success)?;
            info.set_item(&known.diverged.key, end.diverged)?;
            if let Some(achieved) = end.achieved {
                info.set_item(&known.achieved.key, achieved)?;
            }
        }
        for (_, episode, receipt) in started(&self.started).chain(ended(&self.ended)) {
            let values = |labels: &[Label], values: &[f64]| {
                let named = PyDict::new(py);
                labels.iter().zip(values).try_for_each(|(label, value)| named.set_item(&label.key, value))?;
                PyResult::Ok(named)
            };
            let told = PyDict::new(py);
            told.set_item(&known.environment_index.key, episode.environment_index)?;
            told.set_item(&known.trial_index.key, episode.trial_index)?;
            told.set_item(&known.episode_index.key, episode.episode_index)?;
            told.set_item(&known.applied.key, values(&self.labels.applied, &receipt.applied)?)?;
            told.set_item(&known.model_hash.key, &receipt.model_hash)?;
            info.set_item(&known.context_id.key, episode.trial_index)?;
            info.set_item(&known.parameters.key, values(&self.labels.parameters, &receipt.requested)?)?;
            info.set_item(&known.receipt.key, told)?;
        }
        Ok(info)
    }

    /// Infos of a batch. `moved`, bool `[N]`, says which environments took a step, at first all; `same_step` has the
    /// infos of ended episodes apart from those of the ones that began in their place.
    #[pyo3(signature = (moved, same_step))]
    fn batch<'py>(
        &self,
        py: Python<'py>,
        moved: Option<PyReadonlyArray1<'py, bool>>,
        same_step: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (infos, known, n) = (PyDict::new(py), &self.labels.known, self.labels.num_envs);
        let mut moved = match moved {
            Some(moved) => moved.as_slice()?.to_vec(),
            None => vec![true; n],
        };
        moved.resize(n, false);
        if !same_step || self.ended.is_empty() {
            self.outcomes(&infos)?;
            self.receipts(&infos, started(&self.started).chain(ended(&self.ended)).collect())?;
            self.terms(&infos, &moved)?;
            return Ok(infos);
        }
        let finals = PyDict::new(py);
        let mut observations: Vec<Py<PyAny>> = (0..n).map(|_| py.None()).collect();
        for (end, row) in self.ended.iter().zip(self.final_observations.chunks(self.observation_size.max(1))) {
            observations[end.slot as usize] = PyArray1::from_slice(py, row).into_any().unbind();
            moved[end.slot as usize] = false;
        }
        let (over, mask) = self.mask(py, self.ended.iter().map(|end| end.slot as usize));
        set(&infos, &known.final_obs, PyArray1::from_vec(py, observations), &mask)?;
        set(&infos, &known.final_info, &finals, &mask)?;
        self.outcomes(&finals)?;
        self.receipts(&finals, ended(&self.ended).collect())?;
        self.terms(&finals, &over)?;
        self.receipts(&infos, started(&self.started).collect())?;
        self.terms(&infos, &moved)?;
        Ok(infos)
    }
}

/// A mask of infos.
type Mask<'py> = Bound<'py, PyArray1<bool>>;

impl Events {
    fn outcomes(&self, infos: &Bound<'_, PyDict>) -> PyResult<()> {
        if self.ended.is_empty() {
            return Ok(());
        }
        let (py, known) = (infos.py(), &self.labels.known);
        let slots = || self.ended.iter().map(|end| end.slot as usize);
        let (_, mask) = self.mask(py, slots());
        let success = slots().zip(self.ended.iter().map(|end| end.success));
        set(infos, &known.is_success, self.column(py, success), &mask)?;
        let diverged = slots().zip(self.ended.iter().map(|end| end.diverged));
        set(infos, &known.diverged, self.column(py, diverged), &mask)?;
        let reached = || slots().zip(&self.ended).filter_map(|(slot, end)| Some((slot, end.achieved?)));
        if reached().next().is_some() {
            let (_, mask) = self.mask(py, reached().map(|(slot, _)| slot));
            set(infos, &known.achieved, self.column(py, reached()), &mask)?;
        }
        Ok(())
    }

    fn receipts(&self, infos: &Bound<'_, PyDict>, told: Vec<Told<'_>>) -> PyResult<()> {
        if told.is_empty() {
            return Ok(());
        }
        let (py, known, labels) = (infos.py(), &self.labels.known, &*self.labels);
        let (_, mask) = self.mask(py, told.iter().map(|(slot, ..)| *slot));
        // All columns in two pieces of memory: a piece for each would take longer than to fill it.
        let (n, applied) = (labels.num_envs, labels.parameters.len());
        let mut values = vec![0.0_f64; (applied + labels.applied.len()) * n];
        let mut counts = vec![0_i64; 4 * n];
        for (slot, episode, receipt) in &told {
            for (i, value) in receipt.requested.iter().chain(&receipt.applied).enumerate() {
                values[i * n + slot] = *value;
            }
            let trial = episode.trial_index as i64;
            let row = [trial, i64::from(episode.environment_index), trial, episode.episode_index as i64];
            row.into_iter().enumerate().for_each(|(i, count)| counts[i * n + slot] = count);
        }
        let values = PyArray1::from_vec(py, values).reshape([applied + labels.applied.len(), n])?;
        let counts = PyArray1::from_vec(py, counts).reshape([4, n])?;
        let named = |labels: &[Label], first: usize| {
            let named = PyDict::new(py);
            for (i, label) in labels.iter().enumerate() {
                set(&named, label, values.get_item(first + i)?, &mask)?;
            }
            PyResult::Ok(named)
        };
        set(infos, &known.context_id, counts.get_item(0)?, &mask)?;
        set(infos, &known.parameters, named(&labels.parameters, 0)?, &mask)?;
        let receipt = PyDict::new(py);
        set(&receipt, &known.environment_index, counts.get_item(1)?, &mask)?;
        set(&receipt, &known.trial_index, counts.get_item(2)?, &mask)?;
        set(&receipt, &known.episode_index, counts.get_item(3)?, &mask)?;
        set(&receipt, &known.applied, named(&labels.applied, applied)?, &mask)?;
        let mut hashes: Vec<Py<PyAny>> = (0..labels.num_envs).map(|_| py.None()).collect();
        // All are of one model, mostly: one text for all of them.
        let mut last: Option<(&str, Py<PyAny>)> = None;
        for (slot, _, receipt) in &told {
            let text = match last.take() {
                Some((known, text)) if same(known, &receipt.model_hash) => text,
                _ => PyString::new(py, &receipt.model_hash).into_any().unbind(),
            };
            hashes[*slot] = text.clone_ref(py);
            last = Some((&receipt.model_hash, text));
        }
        set(&receipt, &known.model_hash, PyArray1::from_vec(py, hashes), &mask)?;
        set(infos, &known.receipt, receipt, &mask)
    }

    fn terms(&self, infos: &Bound<'_, PyDict>, moved: &[bool]) -> PyResult<()> {
        let (py, names) = (infos.py(), &self.labels.reward_terms);
        if self.reward_terms.is_empty() || !moved.contains(&true) {
            return Ok(());
        }
        let slots = || (0..moved.len()).filter(|&slot| moved[slot]);
        let (named, (_, mask)) = (PyDict::new(py), self.mask(py, slots()));
        for (i, label) in names.iter().enumerate() {
            let column = slots().map(|slot| (slot, f64::from(self.reward_terms[slot * names.len() + i])));
            set(&named, label, self.column(py, column), &mask)?;
        }
        set(infos, &self.labels.known.reward_terms, named, &mask)
    }

    /// Values `[N]`, zero where there are none.
    fn column<'py, T: Element + Copy + Default>(
        &self,
        py: Python<'py>,
        values: impl Iterator<Item = (usize, T)>,
    ) -> Bound<'py, PyArray1<T>> {
        let mut column = vec![T::default(); self.labels.num_envs];
        values.for_each(|(slot, value)| column[slot] = value);
        PyArray1::from_vec(py, column)
    }

    /// A mask `[N]`, not to change: many keys have the same one.
    fn mask<'py>(&self, py: Python<'py>, slots: impl Iterator<Item = usize>) -> (Vec<bool>, Mask<'py>) {
        let mut mask = vec![false; self.labels.num_envs];
        slots.for_each(|slot| mask[slot] = true);
        let array = PyArray1::from_slice(py, &mask);
        array.readwrite().make_nonwriteable();
        (mask, array)
    }
}

fn set<'py>(
    infos: &Bound<'py, PyDict>,
    label: &Label,
    value: impl IntoPyObject<'py>,
    mask: &Mask<'py>,
) -> PyResult<()> {
    infos.set_item(&label.key, value)?;
    infos.set_item(&label.mask, mask)
}

/// Whether two texts are equal. To compare empty ones, which lie nowhere, takes some processors 100 ns.
fn same(one: &str, other: &str) -> bool {
    one.len() == other.len() && (one.is_empty() || one == other)
}

fn started(started: &[proto::EpisodeStart]) -> impl Iterator<Item = Told<'_>> {
    started.iter().filter_map(|start| Some((start.slot as usize, start.episode.as_ref()?, start.receipt.as_ref()?)))
}

fn ended(ended: &[proto::EpisodeEnd]) -> impl Iterator<Item = Told<'_>> {
    ended.iter().filter_map(|end| Some((end.slot as usize, end.episode.as_ref()?, end.receipt.as_ref()?)))
}
