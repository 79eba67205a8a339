//! Fuzz targets: functions that process bytes which untrusted clients send or which files contain.
//!
//! No input may cause a panic or a hang, or change the replies to another client. libFuzzer runs the targets (`make
//! fuzz`, with AddressSanitizer). A test also runs them for a few seconds, with any compiler.

mod files;
mod folders;
mod seeds;
mod server;

pub use files::{checkpoints, ledgers, plans, records};
pub use folders::{models, tasks};
pub use seeds::{replies, seeds};
pub use server::{connections, requests, snapshots, worlds};

/// A fuzz target: a function that processes untrusted bytes.
pub struct FuzzTarget {
    /// The name of its program and of its folder in `corpus/`.
    pub name: &'static str,
    /// Runs the target on one input.
    pub run: fn(&[u8]),
}

/// All fuzz targets.
pub const TARGETS: [FuzzTarget; 10] = [
    FuzzTarget { name: "requests", run: requests },
    FuzzTarget { name: "snapshots", run: snapshots },
    FuzzTarget { name: "worlds", run: worlds },
    FuzzTarget { name: "connections", run: connections },
    FuzzTarget { name: "checkpoints", run: checkpoints },
    FuzzTarget { name: "records", run: records },
    FuzzTarget { name: "plans", run: plans },
    FuzzTarget { name: "ledgers", run: ledgers },
    FuzzTarget { name: "tasks", run: tasks },
    FuzzTarget { name: "models", run: models },
];
