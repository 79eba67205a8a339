//! Environments over gRPC.
//!
//! [`Servers`] holds the connections, [`Session`] a batch of environments that may be spread over them, [`PrivateServer`]
//! a server of the learner's own, [`Single`] one environment that is drawn. The interface is blocking: a
//! single-threaded tokio runtime inside [`Servers`] runs on the caller's thread, while a call waits. A hand-over to another thread would double a step's latency.
//! Long computations between two calls belong into [`Servers::keep_alive_during`].

mod servers;
mod session;
mod single;

pub use perturb_protocol::{Address, AddressError, ClientError, PrivateServer};
pub use servers::Servers;
pub use session::{EndedEpisode, OpenOptions, Session, StepReply};
pub use single::{BegunEpisode, Picture, Single};
