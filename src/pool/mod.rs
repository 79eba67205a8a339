//! Batches of environments, stepped by worker threads.
//!
//! A batch is cut into shards, each with its environments and its own output buffers. A request puts the batch into the
//! workers' queue; a worker takes one shard of the batch at the queue's head and puts the batch back at its tail if
//! shards remain, so that batches of different sessions take turns, whatever their sizes. The last shard to finish
//! wakes the session, which gathers the outputs into one reply. Which worker ran which shard cannot be seen from
//! outside.
//!
//! A pipelined step is requested while another one runs. It begins as soon as that step ends: the last shard's worker
//! gathers the outputs and puts the batch back into the queue before the session is woken.
//!
//! During a rollout of a policy the last shard's worker gathers the outputs, computes the next actions and puts the
//! batch back into the queue. Only the end of the rollout wakes the session.

mod batch;
mod capacity;
mod encode;
mod job;
mod pipelined_step;
mod reaper;
mod receipts;
mod rollout;
mod scheduler;
mod settings;
mod shard;
mod step_queue;
mod step_result;
mod sync;

pub use batch::{Batch, DropHook, ResetEntry};
pub use rollout::{
    policy_runner::{Policy, PolicyRole, PolicyRunner},
    task::{EndedAt, Rollout, RolloutRequest},
};
pub use scheduler::Pool;
pub use settings::{Autoreset, BatchSettings, SlotGroup};
pub use step_queue::StepQueue;
pub use step_result::StepResult;

use crate::env;

/// A refused or failed request.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An environment or a snapshot is not valid. Nothing was changed.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool has no room. Nothing was changed.
    #[error(
        "{requested} environments were asked for, but {used} of this server's {limit} are in use; open fewer, or later"
    )]
    Full {
        /// The batch size that was asked for.
        requested: usize,
        /// Environments in use.
        used: usize,
        /// The maximum number of environments.
        limit: usize,
    },
    /// Autoreset is disabled and some environments have ended. Nothing was changed.
    #[error(
        "the episodes of slots {slots} have ended and autoreset is disabled; reset these slots before the next step"
    )]
    Ended {
        /// The first few of these slots, separated by commas.
        slots: String,
    },
    /// An input or an output of a policy is not finite.
    #[error("the policy's play has ended: {0}; hand over another policy")]
    Policy(#[from] perturb_policy::Error),
    /// A worker panicked: a defect of the server. The batch is lost.
    #[error(
        "the simulation failed because of a server bug; open a new session, and report the bug with the server's log"
    )]
    Defect,
}
