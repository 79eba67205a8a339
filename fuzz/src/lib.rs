//! Fuzz targets: functions of the bytes that untrusted clients send or that files contain.
//!
//! No input may panic, hang, or change what another client gets. libFuzzer runs them (`make fuzz`, with
//! AddressSanitizer), and so does a test, for a few seconds and with any compiler.

mod files;
mod folders;
mod seeds;
mod server;

pub use files::{checkpoints, ledgers, plans, records};
pub use folders::{models, tasks};
pub use seeds::{replies, seeds};
pub use server::{connections, requests, snapshots, worlds};

/// A function of untrusted bytes.
pub struct FuzzTarget {
    /// Name of its program and of its folder in `corpus/`.
    pub name: &'static str,
    /// Runs it on an input.
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
