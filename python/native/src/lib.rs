//! The Python package's native module, `perturb._native`: sessions of the protocol, as Python objects and NumPy arrays.
//!
//! - [`session`]: a session that waits for its replies without Python's lock, hears of signals, and survives forks.
//! - [`embedded`]: the server in this process, and its side of a session.
//! - [`session_runtime`]: the runtime of a session's connection, driven by the thread that waits.
//! - [`requests`]: conversion of Python's values to requests.
//! - [`arrays`], [`infos`]: replies, as arrays and dictionaries; [`episode_table`]: the episodes that these are made of.
//! - [`policy`]: trained policies that act here, by the learner's arithmetic.
//! - [`sets`], [`testing`], [`records`]: tests of policies that act in Python, recorded as `perturb` records its own tests.
//! - [`assessed`]: folders and reports of such tests; [`comparison`]: comparisons of them.
//! - [`failure`]: failures as data, which the Python package turns into its errors.
#![forbid(unsafe_code)]
// The map above is for readers of this crate. All items are private, because only Python uses them.
#![allow(rustdoc::private_intra_doc_links)]

use pyo3::prelude::*;

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

/// The module `perturb._native`; `perturb/_native.pyi` has its types.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::assessed::{Assessment, report_page};
    #[pymodule_export]
    use super::comparison::compare;
    #[pymodule_export]
    use super::embedded::NativeServer;
    #[pymodule_export]
    use super::failure::Failure;
    #[pymodule_export]
    use super::infos::Events;
    #[pymodule_export]
    use super::policy::{Player, Policy};
    #[pymodule_export]
    use super::records::{Records, metrics, published, read_results, wilson};
    #[pymodule_export]
    use super::session::{Session, catalogue, note_fork};
    #[pymodule_export]
    use super::sets::{heatmap_contexts, make_set, read_csv_set, read_sets};
    #[pymodule_export]
    use super::testing::Tests;
    /// Name of the set that `perturb.sets.heatmap` makes. Reports draw a heatmap of the tests on it.
    #[pymodule_export]
    const HEATMAP_SET: &str = perturb_records::Heatmap::SET;
    /// Maximum number of points along a heatmap's axis.
    #[pymodule_export]
    const MAX_HEATMAP_POINTS: usize = perturb_records::MAX_POINTS;
}
