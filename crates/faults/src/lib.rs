//! Bad luck for tests and benches, once for all of them:
//!
//! - [`line`](mod@line): a proxy that delays, ends, halves, changes and half-closes what passes.
//! - [`certificates`]: of authorities of a test's own, good and bad.
//! - [`dice`]: where and when, by a seed that is printed and can be given.
//! - [`disk`]: commands whose files have no room.

pub mod certificates;
pub mod dice;
pub mod disk;
pub mod line;

pub use dice::Dice;
pub use line::{Course, Fault, Kind, Line};
