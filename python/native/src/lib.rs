//! The Python package's native module, `perturb._native`: sessions of the protocol, as Python objects and NumPy arrays.
//!
//! - [`session`]: a session, which releases the GIL while it waits, handles signals, and survives forks of its process.
//! - [`embedded`]: the server in this process, and its sessions.
//! - [`session_runtime`]: the async runtime of a session's connection, driven by the waiting thread.
//! - [`requests`]: conversion of Python's values to requests.
//! - [`arrays`], [`infos`]: conversion of replies to arrays and dictionaries; [`episode_table`]: the episodes in infos.
//! - [`policy`]: trained policies, which choose the same actions as in the learner.
//! - [`sets`], [`testing`], [`records`]: test sets, tests of policies that act in Python, and the records of tests.
//! - [`assessed`]: folders and reports of tests; [`comparison`]: comparisons of tests.
//! - [`failure`]: the exception that the Python package converts to its errors.
#![forbid(unsafe_code)]
// The list above links to private modules for readers of this crate. The crate has no public items, because only Python
// uses the crate.
#![allow(rustdoc::private_intra_doc_links)]

use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyInt};

mod arrays;
mod assessed;
mod comparison;
mod embedded;
mod episode_table;
mod failure;
mod infos;
mod policy;
mod records;
mod requests;
mod session;
mod session_runtime;
mod sets;
mod testing;

/// The module `perturb._native`. `perturb/_native.pyi` declares its types.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::assessed::{Assessment, report_page};
    #[pymodule_export]
    use super::comparison::{compare, compare_rows};
    #[pymodule_export]
    use super::embedded::NativeServer;
    #[pymodule_export]
    use super::failure::Failure;
    #[pymodule_export]
    use super::infos::Events;
    #[pymodule_export]
    use super::policy::{PythonPlayer, PythonPolicy};
    #[pymodule_export]
    use super::records::{PythonRecords, metrics, published, read_results, wilson};
    #[pymodule_export]
    use super::session::{PythonSession, catalogue, note_fork};
    #[pymodule_export]
    use super::sets::{heatmap_contexts, make_set, read_csv_set, read_sets};
    #[pymodule_export]
    use super::testing::PythonTests;
    /// Name of the test set that `perturb.sets.heatmap` makes. Reports draw the tests on it as heatmaps.
    #[pymodule_export]
    const HEATMAP_SET: &str = perturb_records::Heatmap::SET;
    /// Maximum number of points along each axis of a heatmap.
    #[pymodule_export]
    const MAX_HEATMAP_POINTS: usize = perturb_records::MAX_POINTS;
    /// Maximum number of contexts in a set.
    #[pymodule_export]
    const MAX_CONTEXTS: usize = perturb_settings::sets::MAX_CONTEXTS;

    /// Runs when Python imports the module.
    #[pymodule_init]
    fn initialise(module: &pyo3::Bound<'_, pyo3::types::PyModule>) -> pyo3::PyResult<()> {
        super::initialise_once_locks(module.py())
    }
}

/// Initialises the static values of PyO3 and NumPy that requests use. They would otherwise be initialised by the first
/// request. If another thread forked the process during that time, the forked process would wait forever for the end of
/// the initialisation.
fn initialise_once_locks(py: Python<'_>) -> PyResult<()> {
    let array = PyArray1::from_slice(py, &[0_f32]);
    array.try_readonly()?;
    requests::is_integer(&array);
    for object in [array.as_any(), PyDict::new(py).as_any(), PyBytes::new(py, b"").as_any()] {
        let wrong_type = object.cast::<PyInt>().err().map(PyErr::from);
        wrong_type.iter().for_each(|error| drop(error.to_string()));
    }
    Ok(())
}
