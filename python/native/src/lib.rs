//! The Python package's native module, `perturb._native`: sessions of the protocol, as Python objects and NumPy arrays.
//!
//! - [`session`]: a session that waits for its replies without Python's lock, hears of signals, and survives forks.
//! - [`line`]: the connection under it, which is driven by the thread that waits.
//! - [`requests`]: requests, made of what Python gives.
//! - [`arrays`], [`infos`]: replies, as arrays and dictionaries; [`told`]: the episodes that these are made of.
//! - [`policy`]: trained policies that act here, by the learner's arithmetic.
//! - [`sets`], [`testing`], [`records`]: tests of whatever acts in Python, recorded as the program `perturb` records its own.
//! - [`assessed`]: such tests as folders, and in reports.
//! - [`failure`]: what went wrong, for the package to say it as one of its errors.
#![forbid(unsafe_code)]
// The map above is for who reads this crate: all that it has is Python's, and private.
#![allow(rustdoc::private_intra_doc_links)]

use pyo3::prelude::*;

mod arrays;
mod assessed;
mod failure;
mod infos;
mod line;
mod policy;
mod records;
mod requests;
mod session;
mod sets;
mod testing;
mod told;

/// What the Python package stands on; `perturb/_native.pyi` has the types.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::assessed::{Assessment, report_page};
    #[pymodule_export]
    use super::failure::Failure;
    #[pymodule_export]
    use super::infos::Events;
    #[pymodule_export]
    use super::policy::{Player, Policy};
    #[pymodule_export]
    use super::records::{Records, metrics, published, wilson};
    #[pymodule_export]
    use super::session::{Session, catalogue};
    #[pymodule_export]
    use super::sets::{heatmap_contexts, make_set, read_csv_set, read_sets};
    #[pymodule_export]
    use super::testing::Tests;
    /// What the set of a heatmap is called.
    #[pymodule_export]
    const HEATMAP_SET: &str = perturb_records::Heatmap::SET;
    /// The most points along a heatmap's axis.
    #[pymodule_export]
    const MOST_POINTS: usize = perturb_records::MOST_POINTS;
}
