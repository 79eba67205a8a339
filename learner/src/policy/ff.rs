//! The feed-forward policy on libtorch.

use tch::Tensor;

use super::{PolicySpec, Weights};
use crate::error::Result;

/// Two separate multilayer perceptrons.
pub struct Policy {
    spec: PolicySpec,
}

/// A policy's view of B observations and actions.
pub struct Evaluated {
    /// [B] log-probabilities of the actions.
    pub log_probs: Tensor,
    /// [B] entropies of the action distributions, in nats.
    pub entropy: Tensor,
    /// [B] values.
    pub values: Tensor,
}

impl Policy {
    /// A policy with initial weights from the stream of `seed`.
    pub fn new(_spec: PolicySpec, _seed: u64) -> Result<Self> {
        todo!()
    }

    /// A policy with the given weights.
    pub fn from_weights(_spec: PolicySpec, _weights: &Weights) -> Result<Self> {
        todo!()
    }

    /// A copy of the weights.
    pub fn weights(&self) -> Weights {
        todo!()
    }

    /// The shape.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// Log-probabilities of `actions` [B, A], entropies and values at `observations` [B, O].
    pub fn evaluate(&self, _observations: &Tensor, _actions: &Tensor) -> Evaluated {
        todo!()
    }
}
