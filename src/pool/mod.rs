//! Runs batches of environments on worker threads.
//!
//! A batch is cut into shards, each with its own environments and output buffers. A request puts the batch into the
//! workers' queue. A worker takes one shard of the batch at the front of the queue. If shards remain, it puts the batch
//! at the back, so that batches of different sessions take turns, whatever their sizes. The worker that finishes the
//! last shard wakes the session, which gathers the outputs into one reply. Results do not depend on which worker ran
//! which shard. A cheap batch is stepped on the session's own thread, because passing it to workers would take longer.
//!
//! A pipelined step is a step that is requested while another step of the batch is running. It starts as soon as the
//! running step ends: the worker of the last shard gathers the outputs and puts the batch back into the queue, before
//! the session is woken.
//!
//! During a rollout of a policy, the worker of the last shard gathers the outputs, computes the next actions and puts
//! the batch back into the queue. The session is woken only at the end of the rollout.

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
    policy_runner::{PolicyRole, PolicyRunner, ReceivedPolicy},
    task::{Rollout, RolloutEpisodeEnd, RolloutRequest},
};
pub use scheduler::Pool;
pub use settings::{Autoreset, BatchSettings, SlotGroupSettings};
pub use step_queue::StepQueue;
pub use step_result::StepResult;

use crate::env;

/// Why a request to a batch was refused or failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An environment or a snapshot is invalid. Nothing was changed.
    #[error(transparent)]
    Environment(#[from] env::Error),
    /// The pool has no room for the environments. Nothing was changed.
    #[error(
        "{requested} environments were asked for, but {used} of this server's {limit} are in use; open fewer, or try \
         again later"
    )]
    Full {
        /// The number of environments that were requested.
        requested: usize,
        /// The number of environments in use.
        used: usize,
        /// The maximum number of environments.
        limit: usize,
    },
    /// A step was requested although autoreset is disabled and some episodes have ended. Nothing was changed.
    #[error(
        "the episodes of slots {slots} have ended and autoreset is disabled; reset these slots before the next step"
    )]
    Ended {
        /// The first few slots whose episodes have ended, separated by commas.
        slots: String,
    },
    /// An input or an output of a policy is not finite. The policy's rollout has ended.
    #[error("the server stopped playing the policy: {0}; send another policy")]
    Policy(#[from] perturb_policy::Error),
    /// A worker panicked, which is a defect of the server. The batch is lost.
    #[error(
        "the simulation failed because of a server bug; open a new session, and report the bug with the server's log"
    )]
    Defect,
}
