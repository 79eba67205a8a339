//! Environments over gRPC.
//!
//! [`Servers`] holds the connections, [`Session`] a batch of environments that may be spread over them, [`PrivateServer`]
//! a server of the learner's own, [`RenderSession`] one environment to be rendered. The interface is blocking: a
//! single-threaded tokio runtime inside [`Servers`] runs on the caller's thread while a call waits. Another thread would
//! double a step's latency. Wrap long computations between two calls in [`Servers::keep_alive_during`].

pub mod acting;
mod backoff;
mod options;
mod render;
mod reply;
mod servers;
mod session;
mod shard;

pub use acting::RolloutReply;
pub use backoff::{Backoff, Reconnect};
pub use options::{ActorLocation, OpenOptions, ServerWait};
pub use perturb_protocol::{Address, AddressError, ClientError, EndedEpisode, PrivateServer};
pub use render::{BegunEpisode, RenderSession, RenderedPicture};
pub use reply::{StepReply, StepSlice};
pub use servers::Servers;
pub use session::Session;
