//! The samples of an update, as tensors.

use perturb_policy::{PolicySpec, SequenceSamples};
use tch::Tensor;

use super::loss::LossTargets;
use super::{Distributions, Sequences, TorchPolicy};
use crate::error::{Error, Result};

/// A rollout, or a minibatch of it: M sequences of L steps. Arrays `[V]` are over its V samples in order, those of
/// padding left out.
pub(crate) struct TensorBatch {
    /// The sequences that the policy is evaluated on.
    pub(crate) sequences: Sequences,
    /// `[L, M, A]`.
    pub(crate) actions: Tensor,
    /// `[L, M]`.
    old_log_probs: Tensor,
    /// `[L, M]`.
    old_values: Tensor,
    /// `[L, M]`.
    advantages: Tensor,
    /// `[L, M]`.
    returns: Tensor,
    /// `[L, M]` the acting policy's action distributions; `None` if no KL divergence is computed.
    acting: Option<Distributions>,
}

impl TensorBatch {
    /// A copy of `sequences`.
    pub(crate) fn new(spec: &PolicySpec, sequences: &SequenceSamples<'_>) -> Result<Self> {
        let SequenceSamples { samples, n_steps, starts, memory, lengths } = *sequences;
        let sequences = Sequences::new(spec, n_steps, samples.observations, starts, memory)?;
        let sequences = match lengths {
            Some(lengths) => sequences.with_lengths(lengths)?,
            None => sequences,
        };
        let n_steps = sequences.n_steps();
        let count = sequences.count();
        let shaped = |data: &[f32]| Tensor::f_of_slice(data)?.f_view((n_steps, count));
        Ok(TensorBatch {
            actions: Tensor::f_of_slice(samples.actions)?.f_view((n_steps, count, spec.action.width() as i64))?,
            old_log_probs: shaped(samples.old_log_probs)?,
            old_values: shaped(samples.old_values)?,
            advantages: shaped(samples.advantages)?,
            returns: shaped(samples.returns)?,
            acting: None,
            sequences,
        })
    }

    /// The sequences at `indices`.
    pub(crate) fn select(&self, indices: &[u32]) -> Result<Self> {
        let indices: Vec<i64> = indices.iter().map(|&index| i64::from(index)).collect();
        let indices = Tensor::f_of_slice(&indices)?;
        let select = |tensor: &Tensor| Ok::<_, Error>(tensor.f_index_select(1, &indices)?);
        Ok(TensorBatch {
            sequences: self.sequences.select(&indices)?,
            actions: select(&self.actions)?,
            old_log_probs: select(&self.old_log_probs)?,
            old_values: select(&self.old_values)?,
            advantages: select(&self.advantages)?,
            returns: select(&self.returns)?,
            acting: self.acting.as_ref().map(|acting| acting.map(select)).transpose()?,
        })
    }

    /// Stores the distributions of `policy` with its present weights as those of the policy that acted. The KL divergence
    /// is measured from them.
    pub(crate) fn remember_acting(&mut self, policy: &TorchPolicy) {
        self.acting = Some(policy.distributions(&self.sequences));
    }

    /// The targets of a loss over the V samples.
    pub(crate) fn targets(&self) -> Result<LossTargets> {
        let samples = |tensor: &Tensor| self.sequences.samples(tensor);
        Ok(LossTargets {
            old_log_probs: samples(&self.old_log_probs)?,
            old_values: samples(&self.old_values)?,
            advantages: samples(&self.advantages)?,
            returns: samples(&self.returns)?,
            acting: self.acting.as_ref().map(|acting| acting.map(samples)).transpose()?,
        })
    }
}
