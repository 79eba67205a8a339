//! The interface of gradient backends.

use crate::act::Actor;
use crate::error::Result;
use crate::losses::Losses;
use crate::objective::Objective;
use crate::recurrent::RecurrentBatch;
use crate::samples::{Samples, SequenceSamples};

/// Computes gradients of policies of one shape. A feed-forward policy has [`Differentiator`](crate::Differentiator), a
/// recurrent one [what is registered](crate::register_recurrent). [`gradient_backend`](crate::gradient_backend) chooses.
pub trait GradientBackend {
    /// Prepares the sequences of a rollout, to be learned from several times.
    ///
    /// # Errors
    /// Arrays whose lengths do not fit, or what libtorch refuses.
    fn batch<'a>(&self, sequences: &SequenceSamples<'a>) -> Result<GradientBatch<'a>>;

    /// Stores the distributions of the policy with `weights` `[P]` as those of the policy that acted in `batch`. The KL
    /// divergence is measured from them.
    ///
    /// # Errors
    /// A batch of other observations, or another number of weights.
    fn remember_acting(&mut self, weights: &[f32], batch: &mut GradientBatch<'_>) -> Result<()>;

    /// Writes the gradient of `objective` with `weights` `[P]` over `sequences` of `batch` to `gradient` `[P]`. Returns the
    /// losses.
    ///
    /// # Errors
    /// Arrays of other lengths, or what libtorch refuses.
    fn gradient(
        &mut self,
        weights: &[f32],
        batch: &GradientBatch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses>;

    /// Must be called when the weights have changed since the last call of this backend.
    fn weights_changed(&mut self);

    /// Takes the networks of an actor that has the present weights, with their cached activations, to skip a forward pass. The
    /// actor must load weights before it acts again. A recurrent policy's backend does nothing.
    fn reuse_activations(&mut self, actor: &mut Actor);
}

/// A rollout as M sequences, each of which the policy must see whole. A recurrent policy needs the steps of an environment
/// in order: M = N. A feed-forward policy takes every sample by itself: M is the number of samples, T·N without padding.
pub enum GradientBatch<'a> {
    /// A batch of a feed-forward policy.
    FeedForward {
        /// The rollout.
        samples: Samples<'a>,
        /// The indices of the samples in the rollout.
        indices: Vec<u32>,
        /// The distributions of the policy that acted, if they were remembered.
        acting: Option<ActingOutputs>,
    },
    /// A batch of a recurrent policy.
    Recurrent(Box<dyn RecurrentBatch>),
}

/// The distributions of the policy that acted, at B samples.
#[derive(Clone, Debug)]
pub struct ActingOutputs {
    /// `[B, n]` logits, or `[B, A]` means.
    pub outputs: Vec<f32>,
    /// `[A]` log standard deviations of continuous actions.
    pub log_std: Vec<f32>,
}

impl GradientBatch<'_> {
    /// The indices of all sequences.
    pub fn sequences(&self) -> Vec<u32> {
        match self {
            Self::FeedForward { indices, .. } => indices.clone(),
            Self::Recurrent(batch) => (0..batch.count() as u32).collect(),
        }
    }
}
