//! The client of the simulation servers: environments over gRPC.
//!
//! [`Servers`] holds the connections. [`ClientSession`] is a batch of environments that may be spread over several
//! servers. [`PrivateServer`] is a server process that the learner starts for itself. [`RenderSession`] is a single
//! environment to be rendered. All calls block: a single-threaded tokio runtime inside [`Servers`] runs on the caller's
//! thread while a call waits. A separate thread would double the latency of a step. Wrap long computations between two
//! calls in [`Servers::keep_alive_during`].

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
pub use session::ClientSession;
