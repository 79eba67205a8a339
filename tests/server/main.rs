//! The tests of the server, in one program so that it is linked only once.
#![allow(clippy::unwrap_used)]

mod common;

mod acting;
mod bounds;
mod catalogue;
mod conformance;
mod contexts;
mod determinism;
mod distributions;
mod disturbances;
mod dm_env_rpc;
mod drawing;
mod faults;
#[cfg(feature = "mujoco")]
mod folder;
mod following;
mod groups;
mod guarded;
mod handler;
mod leases;
mod lifecycle;
#[cfg(feature = "mujoco")]
mod locomotion;
mod metrics;
mod observing;
mod old_snapshots;
mod pool;
mod receipt_arrays;
mod reference;
mod rendering;
mod reply_bounds;
mod restoring;
#[cfg(feature = "mujoco")]
mod sharing;
mod streams;
mod success;
mod toy;
#[cfg(feature = "otel")]
mod traces;
mod transport_threads;
mod unheard;
