//! The reply that opened a session.

use std::sync::Arc;

use bytes::Bytes;
use numpy::PyArray2;
use perturb_protocol::proto;
use pyo3::prelude::*;

use crate::arrays;
use crate::infos::Events;

/// The reply that opened a session.
#[pyclass(frozen, module = "perturb._native")]
pub struct Opened {
    /// The environment that was opened, as JSON of the catalogue.
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
    /// Returns the environment that was opened.
    pub fn served(&self) -> &Arc<proto::Environment> {
        &self.served
    }
}
