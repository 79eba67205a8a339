//! What strangers may send to a server or write into files, as functions of bytes. None may panic, hang, or change what
//! somebody else gets. libFuzzer drives them (`make fuzz`, with AddressSanitizer), and so does a test, for seconds and
//! with any compiler.

mod files;
mod seeds;
mod server;

pub use files::{checkpoints, ledgers, plans, records};
pub use seeds::{replies, seeds};
pub use server::{connections, requests, snapshots, worlds};

/// Something that takes a stranger's bytes.
pub struct Target {
    /// The name of its program and of its folder in `corpus/`.
    pub name: &'static str,
    /// Hands it the bytes.
    pub run: fn(&[u8]),
}

/// All that are attacked.
pub const TARGETS: [Target; 8] = [
    Target { name: "requests", run: requests },
    Target { name: "snapshots", run: snapshots },
    Target { name: "worlds", run: worlds },
    Target { name: "connections", run: connections },
    Target { name: "checkpoints", run: checkpoints },
    Target { name: "records", run: records },
    Target { name: "plans", run: plans },
    Target { name: "ledgers", run: ledgers },
];
