//! Fault injection for tests and benchmarks:
//!
//! - [`proxy`]: a proxy that delays, drops and changes bytes, and closes connections.
//! - [`certificates`]: valid and invalid certificates.
//! - [`rng`]: random faults and pauses from a seed. The seed is printed, so that a failure can be repeated.
//! - [`disk`]: commands that run with a full disk.
//! - [`processes`]: commands that run with a limit of processes and threads.

pub mod certificates;
pub mod disk;
pub mod processes;
pub mod proxy;
pub mod rng;

pub use proxy::{ByteFault, FaultKind, FaultPlan, FaultyProxy};
pub use rng::SeededRng;
