//! Acting.

use rand_chacha::ChaCha8Rng;

use super::{ActionKind, PolicySpec, Weights};
use crate::error::Result;

/// Computes actions, log-probabilities and values for up to `max_batch` observations at a time.
pub struct Actor {}

impl Actor {
    /// An actor whose weights are all 0 until [`Actor::load`].
    pub fn new(_spec: &PolicySpec, _max_batch: usize) -> Self {
        todo!()
    }

    /// Takes over weights.
    pub fn load(&mut self, _weights: &Weights) -> Result<()> {
        todo!()
    }

    /// Samples an action for each normalised observation of `observations` [N, O], in order of n.
    pub fn act(&mut self, _observations: &[f32], _rng: &mut ChaCha8Rng, _out: &mut Acts) -> Result<()> {
        todo!()
    }

    /// Values of `observations` [N, O] into `out` [N].
    pub fn values(&mut self, _observations: &[f32], _out: &mut Vec<f32>) -> Result<()> {
        todo!()
    }
}

/// What a policy did in N environments.
#[derive(Clone, Debug, PartialEq)]
pub struct Acts {
    /// The kind of the actions.
    pub kind: ActionKind,
    /// [N, A] actions as sampled, not clipped. A discrete action is its index as f32, exact below 2²⁴, with A = 1.
    pub actions: Vec<f32>,
    /// [N] log-probabilities (densities) of the actions.
    pub log_probs: Vec<f32>,
    /// [N] values of the observations.
    pub values: Vec<f32>,
}

impl Acts {
    /// No actions yet, room for `n_envs`.
    pub fn new(_kind: ActionKind, _n_envs: usize) -> Self {
        todo!()
    }

    /// Replaces `bytes` by the actions as the protocol wants them: little-endian i32 [N], or f32 [N, A].
    pub fn write_bytes(&self, _bytes: &mut Vec<u8>) {
        todo!()
    }
}
