//! The interface of gradient backends.

use crate::act::Actor;
use crate::error::Result;
use crate::losses::Losses;
use crate::objective::Objective;
use crate::recurrent::RecurrentBatch;
use crate::samples::{Samples, SequenceSamples};

/// Computes gradients for policies of one shape. [`Differentiator`](crate::Differentiator) implements it for
/// feed-forward policies, and a [registered library](crate::register_recurrent) for recurrent ones.
/// [`gradient_backend`](crate::gradient_backend) chooses between them.
pub trait GradientBackend {
    /// Prepares the sequences of a rollout, so that several gradients can be computed from them.
    ///
    /// # Errors
    /// An error if an array has the wrong length, or if libtorch reports one.
    fn batch<'a>(&self, sequences: &SequenceSamples<'a>) -> Result<GradientBatch<'a>>;

    /// Computes the action distributions of the policy that acted, whose weights are `weights` `[P]`, and stores them
    /// in `batch`. The KL divergence is measured from these distributions.
    ///
    /// # Errors
    /// An error if the batch does not fit this policy, or if the number of weights is wrong.
    fn remember_acting(&mut self, weights: &[f32], batch: &mut GradientBatch<'_>) -> Result<()>;

    /// Computes the gradient of `objective` at `weights` `[P]` over the `sequences` of `batch`, given by their indices.
    /// Writes it to `gradient` `[P]`, and returns the losses.
    ///
    /// # Errors
    /// An error if an array has the wrong length, or if libtorch reports one.
    fn gradient(
        &mut self,
        weights: &[f32],
        batch: &GradientBatch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses>;

    /// Tells the backend that the weights have changed. Call it after every change, before the next gradient.
    fn weights_changed(&mut self);

    /// Takes over the networks of an actor that has the current weights, with their cached activations, to skip a
    /// forward pass. The actor must load weights before it acts again. A recurrent policy's backend does nothing.
    fn reuse_activations(&mut self, actor: &mut Actor);
}

/// A rollout prepared for gradients, as M sequences that a minibatch cannot split. A recurrent policy needs the steps
/// of an environment in order, so a sequence is an environment and M = N. For a feed-forward policy each sample is a
/// sequence of its own, so M is the number of samples: T·N minus padding.
pub enum GradientBatch<'a> {
    /// A batch of a feed-forward policy.
    FeedForward {
        /// The samples of the rollout, `[T, N, …]`, with padding.
        samples: Samples<'a>,
        /// The indices of the samples in the rollout that are not padding.
        indices: Vec<u32>,
        /// The action distributions of the policy that acted, if [`GradientBackend::remember_acting`] stored them.
        acting: Option<ActingOutputs>,
    },
    /// A batch of a recurrent policy.
    Recurrent(Box<dyn RecurrentBatch>),
}

/// The action distributions of the policy that acted, for B samples.
#[derive(Clone, Debug)]
pub struct ActingOutputs {
    /// `[B, n]` logits, or `[B, A]` means.
    pub outputs: Vec<f32>,
    /// `[A]` log standard deviations of continuous actions.
    pub log_std: Vec<f32>,
}

impl GradientBatch<'_> {
    /// Returns the indices of all sequences.
    pub fn sequences(&self) -> Vec<u32> {
        match self {
            Self::FeedForward { indices, .. } => indices.clone(),
            Self::Recurrent(batch) => (0..batch.count() as u32).collect(),
        }
    }
}
