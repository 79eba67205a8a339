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
//! it, as `VectorEnv._add_info` of Gymnasium makes them. `parameters` and `receipt`, two dozen arrays, are made when
//! somebody looks at them.

use std::sync::Arc;

use bytes::Bytes;
use numpy::{Element, PyArray1, PyArrayMethods, PyReadonlyArray1};
use perturb_protocol::proto;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString, PyType};

use crate::arrays;
use crate::told::{Told, misfit};

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
    /// SHA-256 of the model.
    model_hash: String,
    /// `perturb.infos.Later`, a dictionary that is filled when somebody looks.
    later: Py<PyType>,
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
    ///
    /// # Errors
    /// Python's, if the package is not whole.
    pub fn new(py: Python<'_>, environment: &proto::Environment, num_envs: usize) -> PyResult<Self> {
        Ok(Self {
            num_envs,
            parameters: environment.parameters.iter().map(|it| Label::new(py, &it.name)).collect(),
            applied: environment.applied.iter().map(|it| Label::new(py, &it.name)).collect(),
            reward_terms: environment.reward_terms.iter().map(|it| Label::new(py, &it.name)).collect(),
            known: Known::new(py),
            model_hash: environment.model_hash.clone(),
            later: py.import("perturb.infos")?.getattr("Later")?.cast_into()?.unbind(),
        })
    }

    /// No episodes yet.
    fn told(&self) -> Told {
        Told::new(self.parameters.len(), self.applied.len())
    }
}

/// What began and ended in a request.
#[pyclass(frozen, module = "perturb._native")]
pub struct Events {
    labels: Arc<Labels>,
    ended: Vec<proto::EpisodeEnd>,
    /// Their receipts, and those of the episodes that began; none if they were not asked for.
    ended_told: Arc<Told>,
    started_told: Arc<Told>,
    final_observations: Vec<f32>,
    /// O.
    observation_size: usize,
    reward_terms: Vec<f32>,
}

impl Events {
    /// Episodes that began.
    ///
    /// # Errors
    /// If they do not fit.
    pub fn begun(labels: &Arc<Labels>, started: Vec<proto::EpisodeStart>) -> PyResult<Self> {
        let started = started.iter().map(|start| (start.slot, start.episode.as_ref(), start.receipt.as_ref()));
        Self {
            labels: Arc::clone(labels),
            ended: Vec::new(),
            ended_told: Arc::default(),
            started_told: Arc::new(labels.told().with_messages(started)?),
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
        let proto::Stepped { ended, started, final_observations, reward_terms, receipt_episodes, .. } = stepped;
        if ended.is_empty() && started.is_empty() && reward_terms.is_empty() && receipt_episodes.is_empty() {
            return Ok(None);
        }
        let [ended_told, started_told] = if receipt_episodes.is_empty() {
            let started = started.iter().map(|start| (start.slot, start.episode.as_ref(), start.receipt.as_ref()));
            let ended = ended.iter().map(|end| (end.slot, end.episode.as_ref(), end.receipt.as_ref()));
            [labels.told().with_messages(ended)?, labels.told().with_messages(started)?]
        } else {
            labels.told().split(&receipt_episodes, &stepped.receipt_values, ended.len())?
        };
        let terms = |bytes: &Bytes| match bytes.is_empty() {
            true => Ok(Vec::new()),
            false => arrays::numbers(bytes, &[labels.num_envs, labels.reward_terms.len()]),
        };
        Self {
            labels: Arc::clone(labels),
            final_observations: arrays::numbers(&final_observations, &[ended.len(), observation_size])?,
            reward_terms: terms(&reward_terms)?,
            ended,
            ended_told: Arc::new(ended_told),
            started_told: Arc::new(started_told),
            observation_size,
        }
        .checked()
        .map(Some)
    }

    /// The episodes that ended, with their receipts.
    pub fn ended(&self) -> impl Iterator<Item = proto::EpisodeEnd> {
        let receipt = |index| self.ended_told.receipt(index, &self.labels.model_hash);
        let whole = move |(index, end): (usize, &proto::EpisodeEnd)| proto::EpisodeEnd {
            receipt: end.receipt.clone().or_else(|| receipt(index)),
            ..end.clone()
        };
        self.ended.iter().enumerate().map(whole)
    }

    fn checked(self) -> PyResult<Self> {
        let told = || self.ended_told.episodes.iter().chain(&self.started_told.episodes);
        let slots = self.ended.iter().map(|end| end.slot.into()).chain(told().map(|row| row[0]));
        if slots.max().is_some_and(|most| most >= self.labels.num_envs as u64) {
            return Err(misfit());
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
        let values = |labels: &[Label], values: &[f64]| {
            let named = PyDict::new(py);
            labels.iter().zip(values).try_for_each(|(label, value)| named.set_item(&label.key, value))?;
            PyResult::Ok(named)
        };
        for ([_, environment, trial, episode, _], row) in self.started_told.rows().chain(self.ended_told.rows()) {
            let (requested, applied) = row.split_at(self.labels.parameters.len());
            let told = PyDict::new(py);
            told.set_item(&known.environment_index.key, environment)?;
            told.set_item(&known.trial_index.key, trial)?;
            told.set_item(&known.episode_index.key, episode)?;
            told.set_item(&known.applied.key, values(&self.labels.applied, applied)?)?;
            told.set_item(&known.model_hash.key, &self.labels.model_hash)?;
            info.set_item(&known.context_id.key, trial)?;
            info.set_item(&known.parameters.key, values(&self.labels.parameters, requested)?)?;
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
            self.receipts(&infos, [&self.started_told, &self.ended_told])?;
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
        self.receipts(&finals, [&self.ended_told])?;
        self.terms(&finals, &over)?;
        self.receipts(&infos, [&self.started_told])?;
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

    fn receipts<const P: usize>(&self, infos: &Bound<'_, PyDict>, parts: [&Arc<Told>; P]) -> PyResult<()> {
        let rows = || parts.iter().flat_map(|part| &part.episodes);
        if rows().next().is_none() {
            return Ok(());
        }
        let (py, known) = (infos.py(), &self.labels.known);
        let slots = || rows().map(|row| row[0] as usize);
        let (_, mask) = self.mask(py, slots());
        let trials = slots().zip(rows().map(|row| row[2] as i64));
        set(infos, &known.context_id, self.column(py, trials), &mask)?;
        let receipts = Receipts {
            labels: Arc::clone(&self.labels),
            parts: parts.map(Arc::clone).into(),
            mask: mask.clone().unbind(),
        };
        let receipts = Bound::new(py, receipts)?;
        let later = |filled_by| self.labels.later.bind(py).call1((receipts.getattr(filled_by)?,));
        set(infos, &known.parameters, later(intern!(py, "parameters"))?, &mask)?;
        set(infos, &known.receipt, later(intern!(py, "receipt"))?, &mask)
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

/// What fills the dictionaries `parameters` and `receipt` of a batch.
#[pyclass(frozen, module = "perturb._native")]
struct Receipts {
    labels: Arc<Labels>,
    /// Of an environment that is in two of them the last counts.
    parts: Vec<Arc<Told>>,
    mask: Py<PyArray1<bool>>,
}

#[pymethods]
impl Receipts {
    /// Values that were drawn or given.
    fn parameters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.values(py, &self.labels.parameters, 0)
    }

    /// Which episode it is, and the values that were read back.
    fn receipt<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (labels, mask) = (&*self.labels, self.mask.bind(py));
        let (known, n, receipt) = (&labels.known, labels.num_envs, PyDict::new(py));
        for (i, label) in [(1, &known.environment_index), (2, &known.trial_index), (3, &known.episode_index)] {
            let mut column = vec![0_i64; n];
            self.rows().for_each(|(row, _)| column[row[0] as usize] = row[i] as i64);
            set(&receipt, label, PyArray1::from_vec(py, column), mask)?;
        }
        set(&receipt, &known.applied, self.values(py, &labels.applied, labels.parameters.len())?, mask)?;
        let hash = PyString::new(py, &labels.model_hash).into_any().unbind();
        let mut hashes: Vec<Py<PyAny>> = (0..n).map(|_| py.None()).collect();
        self.rows().for_each(|(row, _)| hashes[row[0] as usize] = hash.clone_ref(py));
        set(&receipt, &known.model_hash, PyArray1::from_vec(py, hashes), mask)?;
        Ok(receipt)
    }
}

impl Receipts {
    fn rows(&self) -> impl Iterator<Item = ([u64; 5], &[f64])> {
        self.parts.iter().flat_map(|part| part.rows())
    }

    /// Columns of values from the `first` on.
    fn values<'py>(&self, py: Python<'py>, labels: &[Label], first: usize) -> PyResult<Bound<'py, PyDict>> {
        let named = PyDict::new(py);
        for (i, label) in labels.iter().enumerate() {
            let mut column = vec![0.0_f64; self.labels.num_envs];
            self.rows().for_each(|(row, values)| column[row[0] as usize] = values[first + i]);
            set(&named, label, PyArray1::from_vec(py, column), self.mask.bind(py))?;
        }
        Ok(named)
    }
}
