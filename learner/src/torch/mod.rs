//! Policies on libtorch: the gradient of a recurrent policy, and a reference for the feed-forward one.

mod batch;
mod distribution;
mod ff;
mod loss;
mod policy;
mod rc;
mod sequences;

pub(crate) use batch::TensorBatch;
pub use distribution::Distributions;
pub use loss::{Targets, evaluate};
pub use policy::{Evaluated, TorchPolicy};
pub use sequences::Sequences;
