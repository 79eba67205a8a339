//! Conversion of Python objects to requests. The Python package has checked their types and shapes. The server checks
//! their values.

use std::collections::HashMap;

use bytes::Bytes;
use numpy::{Element, PyArrayDyn, PyArrayMethods, PyUntypedArrayMethods};
use perturb_protocol::{Version, proto};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyInt, PyType};

use crate::failure::{INVALID, failure};

/// The intervals `(low, high)` of each parameter, by the parameter's name.
pub type IntervalsByName = HashMap<String, Vec<(f64, f64)>>;

/// Converts the intervals of parameters to the protocol's distributions.
pub fn distributions(parameters: IntervalsByName) -> HashMap<String, proto::Distribution> {
    let interval = |(low, high)| proto::Interval { low, high };
    let distribution =
        |intervals: Vec<_>| proto::Distribution { intervals: intervals.into_iter().map(interval).collect() };
    parameters.into_iter().map(|(name, intervals)| (name, distribution(intervals))).collect()
}

/// Parses a version: `D`, `R`, `E` or `R+E`.
///
/// # Errors
/// If the text is not the name of a version.
pub fn version(name: &str) -> PyResult<proto::Version> {
    let version: Version =
        name.parse().map_err(|error: perturb_protocol::UnknownVersion| failure(INVALID, 0, error.to_string()))?;
    Ok(version.to_proto())
}

/// Parses Gymnasium's name of an autoreset mode.
///
/// # Errors
/// If the text is not the name of a mode.
pub fn autoreset_mode(name: &str) -> PyResult<proto::AutoresetMode> {
    match name {
        "NextStep" => Ok(proto::AutoresetMode::NextStep),
        "SameStep" => Ok(proto::AutoresetMode::SameStep),
        "Disabled" => Ok(proto::AutoresetMode::Disabled),
        _ => Err(failure(INVALID, 0, format!("`{name}` is none of NextStep, SameStep and Disabled"))),
    }
}

/// The shape and type of a session's actions.
pub struct Actions {
    /// Number of environments N.
    pub num_envs: usize,
    /// The number A of values in a continuous action; `None` for discrete actions.
    pub size: Option<usize>,
    /// Whether there is a single environment, whose actions have no batch axis.
    pub single: bool,
}

impl Actions {
    /// Encodes actions for the protocol: int32 `[N]`, or float32 `[N, A]`. Arrays of the usual types with the right
    /// shape are read directly. For everything else, calls the Python function `fallback`, which returns bytes or
    /// raises an error.
    ///
    /// # Errors
    /// The errors of `fallback`.
    pub fn encode(&self, actions: &Bound<'_, PyAny>, fallback: &Bound<'_, PyAny>) -> PyResult<Bytes> {
        let known = match self.size {
            None => self.choices(actions),
            Some(_) => self
                .read(actions, |number: f32| Some(number.to_le_bytes()))
                .or_else(|| self.read(actions, |number: f64| Some((number as f32).to_le_bytes()))),
        };
        if let Some(bytes) = known {
            return Ok(bytes);
        }
        let bytes = fallback.call1((actions,))?;
        Ok(Bytes::copy_from_slice(bytes.cast::<PyBytes>()?.as_bytes()))
    }

    fn choices(&self, actions: &Bound<'_, PyAny>) -> Option<Bytes> {
        if self.single && is_integer(actions) {
            return Some(Bytes::copy_from_slice(&actions.extract::<i32>().ok()?.to_le_bytes()));
        }
        self.read(actions, |choice: i64| i32::try_from(choice).ok().map(i32::to_le_bytes))
            .or_else(|| self.read(actions, |choice: i32| Some(choice.to_le_bytes())))
    }

    /// Encodes the numbers of an array. Returns `None` if the array does not have type `T`, the expected shape and
    /// contiguous elements. Also returns `None` if `encode` returns `None` for a number.
    fn read<T: Element + Copy>(
        &self,
        actions: &Bound<'_, PyAny>,
        encode: impl Fn(T) -> Option<[u8; 4]>,
    ) -> Option<Bytes> {
        let array = actions.cast::<PyArrayDyn<T>>().ok()?;
        let shape = [self.num_envs, self.size.unwrap_or(1)];
        let expected = &shape[usize::from(self.single)..if self.size.is_some() { 2 } else { 1 }];
        if array.shape() != expected {
            return None;
        }
        let array = array.try_readonly().ok()?;
        let mut bytes = Vec::with_capacity(array.len() * 4);
        for &number in array.as_slice().ok()? {
            bytes.extend_from_slice(&encode(number)?);
        }
        Some(bytes.into())
    }
}

/// Whether the action is an integer of Python or NumPy. Returns false for a bool.
pub fn is_integer(action: &Bound<'_, PyAny>) -> bool {
    static NUMPY_INTEGER: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    action.is_exact_instance_of::<PyInt>()
        || NUMPY_INTEGER
            .import(action.py(), "numpy", "integer")
            .is_ok_and(|integer| action.is_instance(integer).unwrap_or(false))
}
