//! Environments over gRPC.
//!
//! [`Servers`] holds the connections, [`Session`] a batch of environments that may be spread over them, [`PrivateServer`]
//! a server of the learner's own, [`Single`] one environment that is drawn. The interface is blocking: a
//! single-threaded tokio runtime inside [`Servers`] runs on the caller's thread, while a call waits. A hand-over to another thread would double a step's latency.
//! Long computations between two calls belong into [`Servers::keep_alive_during`].

pub mod acting;
mod options;
mod part;
mod reply;
mod servers;
mod session;
mod single;
mod waiting;

pub use acting::Played;
pub use options::{ActAt, OpenOptions, ServerWait};
pub use perturb_protocol::{Address, AddressError, ClientError, EndedEpisode, PrivateServer};
pub use reply::{StepReply, StepSlice};
pub use servers::Servers;
pub use session::Session;
pub use single::{BegunEpisode, Picture, Single};
pub use waiting::{After, Waiting};
