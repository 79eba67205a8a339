//! Fault injection for tests and benchmarks:
//!
//! - [`proxy`]: a proxy that delays, closes, drops and changes bytes.
//! - [`certificates`]: valid and invalid certificates.
//! - [`rng`]: random positions and times from a printed seed.
//! - [`disk`]: commands on full disks.

pub mod certificates;
pub mod disk;
pub mod proxy;
pub mod rng;

pub use proxy::{ByteFault, FaultKind, FaultPlan, FaultyProxy};
pub use rng::SeededRng;
