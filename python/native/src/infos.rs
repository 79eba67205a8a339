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
use numpy::{Element, PyArray1, PyReadonlyArray1};
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
        let (finals, mut over) = (PyDict::new(py), vec![false; n]);
        let mut observations: Vec<Py<PyAny>> = (0..n).map(|_| py.None()).collect();
        for (end, row) in self.ended.iter().zip(self.final_observations.chunks(self.observation_size.max(1))) {
            observations[end.slot as usize] = PyArray1::from_slice(py, row).into_any().unbind();
            over[end.slot as usize] = true;
            moved[end.slot as usize] = false;
        }
        set(&infos, &known.final_obs, PyArray1::from_vec(py, observations), &over)?;
        set(&infos, &known.final_info, &finals, &over)?;
        self.outcomes(&finals)?;
        self.receipts(&finals, ended(&self.ended).collect())?;
        self.terms(&finals, &over)?;
        self.receipts(&infos, started(&self.started).collect())?;
        self.terms(&infos, &moved)?;
        Ok(infos)
    }
}

impl Events {
    fn outcomes(&self, infos: &Bound<'_, PyDict>) -> PyResult<()> {
        if self.ended.is_empty() {
            return Ok(());
        }
        let known = &self.labels.known;
        self.put(infos, &known.is_success, self.ended.iter().map(|end| (end.slot as usize, end.success)))?;
        self.put(infos, &known.diverged, self.ended.iter().map(|end| (end.slot as usize, end.diverged)))?;
        let mut reached = self.ended.iter().filter_map(|end| Some((end.slot as usize, end.achieved?))).peekable();
        if reached.peek().is_some() {
            self.put(infos, &known.achieved, reached)?;
        }
        Ok(())
    }

    fn receipts(&self, infos: &Bound<'_, PyDict>, told: Vec<Told<'_>>) -> PyResult<()> {
        if told.is_empty() {
            return Ok(());
        }
        let (py, known, labels) = (infos.py(), &self.labels.known, &*self.labels);
        let mask = self.mask(told.iter().map(|(slot, ..)| *slot));
        let trials = || told.iter().map(|(slot, episode, _)| (*slot, episode.trial_index as i64));
        let named = |labels: &[Label], values: fn(&proto::Receipt) -> &[f64]| {
            let named = PyDict::new(py);
            for (i, label) in labels.iter().enumerate() {
                let column = told.iter().map(|(slot, _, receipt)| (*slot, values(receipt)[i]));
                set(&named, label, self.column(py, column), &mask)?;
            }
            PyResult::Ok(named)
        };
        self.put(infos, &known.context_id, trials())?;
        set(infos, &known.parameters, named(&labels.parameters, |receipt| &receipt.requested)?, &mask)?;
        let receipt = PyDict::new(py);
        let indices = told.iter().map(|(slot, episode, _)| (*slot, i64::from(episode.environment_index)));
        self.put(&receipt, &known.environment_index, indices)?;
        self.put(&receipt, &known.trial_index, trials())?;
        let episodes = told.iter().map(|(slot, episode, _)| (*slot, episode.episode_index as i64));
        self.put(&receipt, &known.episode_index, episodes)?;
        set(&receipt, &known.applied, named(&labels.applied, |receipt| &receipt.applied)?, &mask)?;
        let mut hashes: Vec<Py<PyAny>> = (0..labels.num_envs).map(|_| py.None()).collect();
        // All are of one model, mostly: one text for all of them.
        let mut last: Option<(&str, Py<PyAny>)> = None;
        for (slot, _, receipt) in &told {
            let text = match &last {
                Some((known, text)) if *known == receipt.model_hash => text.clone_ref(py),
                _ => PyString::new(py, &receipt.model_hash).into_any().unbind(),
            };
            last = Some((&receipt.model_hash, text.clone_ref(py)));
            hashes[*slot] = text;
        }
        set(&receipt, &known.model_hash, PyArray1::from_vec(py, hashes), &mask)?;
        set(infos, &known.receipt, receipt, &mask)
    }

    fn terms(&self, infos: &Bound<'_, PyDict>, moved: &[bool]) -> PyResult<()> {
        let names = &self.labels.reward_terms;
        if self.reward_terms.is_empty() || !moved.contains(&true) {
            return Ok(());
        }
        let named = PyDict::new(infos.py());
        for (i, label) in names.iter().enumerate() {
            let rows = self.reward_terms.chunks(names.len()).zip(moved);
            let column = rows.map(|(row, &moved)| if moved { f64::from(row[i]) } else { 0.0 }).collect();
            set(&named, label, PyArray1::from_vec(infos.py(), column), moved)?;
        }
        set(infos, &self.labels.known.reward_terms, named, moved)
    }

    fn put<T: Element + Copy + Default>(
        &self,
        infos: &Bound<'_, PyDict>,
        label: &Label,
        values: impl Iterator<Item = (usize, T)> + Clone,
    ) -> PyResult<()> {
        let mask = self.mask(values.clone().map(|(slot, _)| slot));
        set(infos, label, self.column(infos.py(), values), &mask)
    }

    /// Values [N], zero where there are none.
    fn column<'py, T: Element + Copy + Default>(
        &self,
        py: Python<'py>,
        values: impl Iterator<Item = (usize, T)>,
    ) -> Bound<'py, PyArray1<T>> {
        let mut column = vec![T::default(); self.labels.num_envs];
        values.for_each(|(slot, value)| column[slot] = value);
        PyArray1::from_vec(py, column)
    }

    fn mask(&self, slots: impl Iterator<Item = usize>) -> Vec<bool> {
        let mut mask = vec![false; self.labels.num_envs];
        slots.for_each(|slot| mask[slot] = true);
        mask
    }
}

/// Each mask is the caller's own, to change.
fn set<'py>(infos: &Bound<'py, PyDict>, label: &Label, value: impl IntoPyObject<'py>, mask: &[bool]) -> PyResult<()> {
    infos.set_item(&label.key, value)?;
    infos.set_item(&label.mask, PyArray1::from_slice(infos.py(), mask))
}

fn started(started: &[proto::EpisodeStart]) -> impl Iterator<Item = Told<'_>> {
    started.iter().filter_map(|start| Some((start.slot as usize, start.episode.as_ref()?, start.receipt.as_ref()?)))
}

fn ended(ended: &[proto::EpisodeEnd]) -> impl Iterator<Item = Told<'_>> {
    ended.iter().filter_map(|end| Some((end.slot as usize, end.episode.as_ref()?, end.receipt.as_ref()?)))
}
