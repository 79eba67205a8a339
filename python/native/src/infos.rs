//! The dictionaries `info` (of one environment) and `infos` (of a batch). They are filled in Rust, because filling them
//! in Python took longer than the steps of the environments.
//!
//! With receipts, the info of a reset has these keys:
//!
//! - `parameters`: the requested value of each parameter, by name;
//! - `receipt`: a dictionary with the episode's `environment_index`, `trial_index` and `episode_index`; `applied`, the
//!   values that were read back from the physics, by name; and `model_hash`, the 32 bytes of the model's SHA-256, or
//!   zeros without a model. The hash is numbers, because libraries that convert infos to other arrays cannot convert
//!   text;
//! - `context_id`: the trial's index, which counts the draws of parameters.
//!
//! With receipts, the info of an episode's last step has the same keys for this episode. With or without receipts, it
//! has `is_success`, `diverged` and `achieved`, the value of the quantity that the success rule compares (NaN if the
//! episode has none). With reward terms, the info of every step has `reward_terms`. No value depends on the clock.
//!
//! In the infos of a batch, each key has an array `[N]` of values. The key with an underscore before it has a mask
//! `[N]` of the environments that have a value, as Gymnasium's `VectorEnv._add_info` makes it.

use std::sync::Arc;

use bytes::Bytes;
use numpy::{Element, PyArray1, PyArrayMethods, PyReadonlyArray1};
use perturb_protocol::proto;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString, PyTuple};

use crate::arrays;
use crate::episode_table::{EpisodeTable, mismatched_episodes};

/// Number of bytes of a SHA-256.
const HASH_BYTES: usize = 32;

/// Decodes a hash from hexadecimal digits. Returns zeros if the text is not a SHA-256.
fn hash_bytes(text: &str) -> [u8; HASH_BYTES] {
    let digits: Option<Vec<u8>> = text.chars().map(|digit| digit.to_digit(16).map(|digit| digit as u8)).collect();
    let bytes = digits.map(|digits| digits.as_chunks::<2>().0.iter().map(|[high, low]| 16 * high + low).collect());
    bytes.and_then(|bytes: Vec<u8>| bytes.try_into().ok()).unwrap_or_default()
}

/// A key of infos, and the key of its mask.
struct Label {
    key: Py<PyString>,
    mask: Py<PyString>,
}

impl Label {
    fn new(py: Python<'_>, name: &str) -> Self {
        Self { key: PyString::new(py, name).unbind(), mask: PyString::new(py, &format!("_{name}")).unbind() }
    }
}

/// The keys of a session's infos as Python strings. The session makes these strings once, not in each step.
pub struct InfoKeys {
    /// Number of environments N.
    num_envs: usize,
    parameters: Vec<Label>,
    applied: Vec<Label>,
    reward_terms: Vec<Label>,
    fixed: FixedLabels,
    /// SHA-256 of the model, as text; empty without a model.
    model_hash: String,
    /// The 32 bytes of the hash; zeros without a model.
    model_hash_bytes: [u8; HASH_BYTES],
}

macro_rules! fixed_labels {
    ($($name:ident),*) => {
        /// The keys that are the same for all environments.
        struct FixedLabels { $($name: Label),* }

        impl FixedLabels {
            fn new(py: Python<'_>) -> Self {
                Self { $($name: Label::new(py, stringify!($name))),* }
            }
        }
    };
}

fixed_labels! {
    is_success, diverged, achieved, context_id, parameters, receipt, applied, environment_index, trial_index,
    episode_index, model_hash, reward_terms, final_obs, final_info
}

impl InfoKeys {
    /// Makes the keys for a session of `num_envs` environments.
    pub fn new(py: Python<'_>, environment: &proto::Environment, num_envs: usize) -> Self {
        Self {
            num_envs,
            parameters: environment.parameters.iter().map(|it| Label::new(py, &it.name)).collect(),
            applied: environment.applied.iter().map(|it| Label::new(py, &it.name)).collect(),
            reward_terms: environment.reward_terms.iter().map(|it| Label::new(py, &it.name)).collect(),
            fixed: FixedLabels::new(py),
            model_hash: environment.model_hash.clone(),
            model_hash_bytes: hash_bytes(&environment.model_hash),
        }
    }

    /// Returns an empty table for this environment's receipts.
    fn episode_table(&self) -> EpisodeTable {
        EpisodeTable::new(self.parameters.len(), self.applied.len())
    }
}

/// The episodes that began or ended in one request, from which infos are made.
#[pyclass(frozen, module = "perturb._native")]
pub struct Events {
    labels: Arc<InfoKeys>,
    ended: Vec<proto::EpisodeEnd>,
    /// Receipts of the episodes that ended; empty if the session has no receipts.
    ended_episodes: EpisodeTable,
    /// Receipts of the episodes that began; empty if the session has no receipts.
    started_episodes: EpisodeTable,
    final_observations: Vec<f32>,
    /// Size O of an observation.
    observation_size: usize,
    reward_terms: Vec<f32>,
}

impl Events {
    /// Makes the events of a request that only began episodes, such as a reset.
    ///
    /// # Errors
    /// If a slot or a receipt does not fit the batch.
    pub fn begun(labels: &Arc<InfoKeys>, started: Vec<proto::EpisodeStart>) -> PyResult<Self> {
        let started = started.iter().map(|start| (start.slot, start.episode.as_ref(), start.receipt.as_ref()));
        Self {
            labels: Arc::clone(labels),
            ended: Vec::new(),
            ended_episodes: EpisodeTable::default(),
            started_episodes: labels.episode_table().with_messages(started)?,
            final_observations: Vec::new(),
            observation_size: 0,
            reward_terms: Vec::new(),
        }
        .checked()
    }

    /// Makes the events of a step. Returns `None` if no episode began or ended and the reply has no reward terms.
    ///
    /// # Errors
    /// If a slot, a receipt or the length of an array does not fit the batch.
    pub fn stepped(labels: &Arc<InfoKeys>, stepped: proto::Stepped, observation_size: usize) -> PyResult<Option<Self>> {
        let proto::Stepped { ended, started, final_observations, reward_terms, receipt_episodes, .. } = stepped;
        if ended.is_empty() && started.is_empty() && reward_terms.is_empty() && receipt_episodes.is_empty() {
            return Ok(None);
        }
        let [ended_episodes, started_episodes] = if receipt_episodes.is_empty() {
            let started = started.iter().map(|start| (start.slot, start.episode.as_ref(), start.receipt.as_ref()));
            let ended = ended.iter().map(|end| (end.slot, end.episode.as_ref(), end.receipt.as_ref()));
            [labels.episode_table().with_messages(ended)?, labels.episode_table().with_messages(started)?]
        } else {
            labels.episode_table().split(&receipt_episodes, &stepped.receipt_values, ended.len())?
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
            ended_episodes,
            started_episodes,
            observation_size,
        }
        .checked()
        .map(Some)
    }

    /// Returns the episodes that ended, with their receipts.
    pub fn ended(&self) -> impl Iterator<Item = proto::EpisodeEnd> {
        let receipt = |index| self.ended_episodes.receipt(index, &self.labels.model_hash);
        let whole = move |(index, end): (usize, &proto::EpisodeEnd)| proto::EpisodeEnd {
            receipt: end.receipt.clone().or_else(|| receipt(index)),
            ..end.clone()
        };
        self.ended.iter().enumerate().map(whole)
    }

    fn checked(self) -> PyResult<Self> {
        let rows = || self.ended_episodes.episodes.iter().chain(&self.started_episodes.episodes);
        let slots = self.ended.iter().map(|end| end.slot.into()).chain(rows().map(|row| row[0]));
        if slots.max().is_some_and(|most| most >= self.labels.num_envs as u64) {
            return Err(mismatched_episodes());
        }
        Ok(self)
    }
}

#[pymethods]
impl Events {
    /// Returns the info of a single environment.
    pub fn single<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (info, fixed) = (PyDict::new(py), &self.labels.fixed);
        if !self.reward_terms.is_empty() {
            let named = PyDict::new(py);
            for (label, &term) in self.labels.reward_terms.iter().zip(&self.reward_terms) {
                named.set_item(&label.key, term)?;
            }
            info.set_item(&fixed.reward_terms.key, named)?;
        }
        if let Some(end) = self.ended.first() {
            info.set_item(&fixed.is_success.key, end.success)?;
            info.set_item(&fixed.diverged.key, end.diverged)?;
            info.set_item(&fixed.achieved.key, end.achieved.unwrap_or(f64::NAN))?;
        }
        let values = |labels: &[Label], values: &[f64]| {
            let named = PyDict::new(py);
            labels.iter().zip(values).try_for_each(|(label, value)| named.set_item(&label.key, value))?;
            PyResult::Ok(named)
        };
        for ([_, environment, trial, episode, _], row) in self.started_episodes.rows().chain(self.ended_episodes.rows())
        {
            let (requested, applied) = row.split_at(self.labels.parameters.len());
            let receipt = PyDict::new(py);
            receipt.set_item(&fixed.environment_index.key, environment)?;
            receipt.set_item(&fixed.trial_index.key, trial)?;
            receipt.set_item(&fixed.episode_index.key, episode)?;
            receipt.set_item(&fixed.applied.key, values(&self.labels.applied, applied)?)?;
            receipt.set_item(&fixed.model_hash.key, PyTuple::new(py, self.labels.model_hash_bytes)?)?;
            info.set_item(&fixed.context_id.key, trial)?;
            info.set_item(&fixed.parameters.key, values(&self.labels.parameters, requested)?)?;
            info.set_item(&fixed.receipt.key, receipt)?;
        }
        Ok(info)
    }

    /// Returns the infos of a batch. `moved`, bool `[N]`, is the mask of environments that took a step; `None` means
    /// all. `same_step` is true if environments reset in the same step in which an episode ends. The key `final_info`
    /// then has the infos of the episodes that ended. The other keys have the receipts of the episodes that began, and
    /// the reward terms of the environments whose episodes continue.
    #[pyo3(signature = (moved, same_step))]
    fn batch<'py>(
        &self,
        py: Python<'py>,
        moved: Option<PyReadonlyArray1<'py, bool>>,
        same_step: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (infos, fixed, n) = (PyDict::new(py), &self.labels.fixed, self.labels.num_envs);
        let mut moved = match moved {
            Some(moved) => moved.as_slice()?.to_vec(),
            None => vec![true; n],
        };
        moved.resize(n, false);
        if !same_step || self.ended.is_empty() {
            self.outcomes(&infos)?;
            self.receipts(&infos, [&self.started_episodes, &self.ended_episodes])?;
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
        set(&infos, &fixed.final_obs, PyArray1::from_vec(py, observations), &mask)?;
        set(&infos, &fixed.final_info, &finals, &mask)?;
        self.outcomes(&finals)?;
        self.receipts(&finals, [&self.ended_episodes])?;
        self.terms(&finals, &over)?;
        self.receipts(&infos, [&self.started_episodes])?;
        self.terms(&infos, &moved)?;
        Ok(infos)
    }
}

/// The mask array `[N]` of a key of infos.
type Mask<'py> = Bound<'py, PyArray1<bool>>;

impl Events {
    fn outcomes(&self, infos: &Bound<'_, PyDict>) -> PyResult<()> {
        if self.ended.is_empty() {
            return Ok(());
        }
        let (py, fixed) = (infos.py(), &self.labels.fixed);
        let slots = || self.ended.iter().map(|end| end.slot as usize);
        let (_, mask) = self.mask(py, slots());
        let success = slots().zip(self.ended.iter().map(|end| end.success));
        set(infos, &fixed.is_success, self.column(py, success), &mask)?;
        let diverged = slots().zip(self.ended.iter().map(|end| end.diverged));
        set(infos, &fixed.diverged, self.column(py, diverged), &mask)?;
        let achieved = slots().zip(self.ended.iter().map(|end| end.achieved.unwrap_or(f64::NAN)));
        set(infos, &fixed.achieved, self.column(py, achieved), &mask)
    }

    /// Adds the parameters and receipts of the episodes in `tables` to `infos`. If several tables have an episode of
    /// the same environment, the episode in the last of these tables is used.
    fn receipts<const P: usize>(&self, infos: &Bound<'_, PyDict>, tables: [&EpisodeTable; P]) -> PyResult<()> {
        let rows = || tables.iter().flat_map(|table| table.rows());
        if rows().next().is_none() {
            return Ok(());
        }
        let (py, labels) = (infos.py(), &*self.labels);
        let (fixed, slot) = (&labels.fixed, |row: &[u64; 5]| row[0] as usize);
        let (_, mask) = self.mask(py, rows().map(|(row, _)| slot(&row)));
        let count = |index: usize| self.column(py, rows().map(move |(row, _)| (row[0] as usize, row[index] as i64)));
        let named = |labels: &[Label], first: usize| {
            let named = PyDict::new(py);
            for (i, label) in labels.iter().enumerate() {
                let column = rows().map(|(row, values)| (slot(&row), values[first + i]));
                set(&named, label, self.column(py, column), &mask)?;
            }
            PyResult::Ok(named)
        };
        set(infos, &fixed.context_id, count(2), &mask)?;
        set(infos, &fixed.parameters, named(&labels.parameters, 0)?, &mask)?;
        let receipt = PyDict::new(py);
        for (index, label) in [(1, &fixed.environment_index), (2, &fixed.trial_index), (3, &fixed.episode_index)] {
            set(&receipt, label, count(index), &mask)?;
        }
        set(&receipt, &fixed.applied, named(&labels.applied, labels.parameters.len())?, &mask)?;
        let mut hashes = vec![0; labels.num_envs * HASH_BYTES];
        rows().for_each(|(row, _)| {
            hashes[slot(&row) * HASH_BYTES..][..HASH_BYTES].copy_from_slice(&labels.model_hash_bytes);
        });
        let hashes = PyArray1::from_vec(py, hashes).reshape([labels.num_envs, HASH_BYTES])?;
        set(&receipt, &fixed.model_hash, hashes, &mask)?;
        set(infos, &fixed.receipt, receipt, &mask)
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
        set(infos, &self.labels.fixed.reward_terms, named, &mask)
    }

    /// Makes an array `[N]` from pairs of a slot and a value. Slots without a value are zero.
    fn column<'py, T: Element + Copy + Default>(
        &self,
        py: Python<'py>,
        values: impl Iterator<Item = (usize, T)>,
    ) -> Bound<'py, PyArray1<T>> {
        let mut column = vec![T::default(); self.labels.num_envs];
        values.for_each(|(slot, value)| column[slot] = value);
        PyArray1::from_vec(py, column)
    }

    /// Makes the mask `[N]` of `slots`. The array is read-only, because several keys share it.
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
