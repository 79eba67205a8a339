//! The reply to opening a session.

use std::sync::Arc;

use bytes::Bytes;
use numpy::PyArray2;
use perturb_protocol::proto;
use pyo3::prelude::*;

use crate::arrays;
use crate::infos::Events;

/// The reply to opening a session.
#[pyclass(frozen, name = "Opened", module = "perturb._native")]
pub struct PythonOpened {
    /// The description of the opened environment, in the JSON format of the catalogue.
    #[pyo3(get)]
    pub(super) environment: String,
    /// Whether observations end with the parameters.
    #[pyo3(get)]
    pub(super) observes_parameters: bool,
    pub(super) served: Arc<proto::Environment>,
    pub(super) observations: Bytes,
    pub(super) shape: [usize; 2],
    /// The first episodes, from which the infos of the first reset are made.
    #[pyo3(get)]
    pub(super) events: Py<Events>,
}

#[pymethods]
impl PythonOpened {
    /// The first observations, `[N, O]`.
    #[getter]
    fn observations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        arrays::rows(py, &self.observations, self.shape[0], self.shape[1])
    }
}

impl PythonOpened {
    /// Returns the server's description of the opened environment.
    pub fn served(&self) -> &Arc<proto::Environment> {
        &self.served
    }
}
