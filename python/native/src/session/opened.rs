//! What opening a session gave.

use std::sync::Arc;

use bytes::Bytes;
use numpy::PyArray2;
use perturb_protocol::proto;
use pyo3::prelude::*;

use crate::arrays;
use crate::infos::Events;

/// What opening a session gave.
#[pyclass(frozen, module = "perturb._native")]
pub struct Opened {
    /// What was opened, as the catalogue has it in JSON.
    #[pyo3(get)]
    pub(super) environment: String,
    /// Whether observations have parameters at their end.
    #[pyo3(get)]
    pub(super) observes_parameters: bool,
    pub(super) served: Arc<proto::Environment>,
    pub(super) observations: Bytes,
    pub(super) shape: [usize; 2],
    /// The begun episodes.
    #[pyo3(get)]
    pub(super) events: Py<Events>,
}

#[pymethods]
impl Opened {
    /// First observations, `[N, O]`.
    #[getter]
    fn observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::rows(py, &self.observations, self.shape[0], self.shape[1])
    }
}

impl Opened {
    /// What was opened.
    pub fn served(&self) -> &Arc<proto::Environment> {
        &self.served
    }
}
