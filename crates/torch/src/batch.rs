//! The samples of an update as tensors.

use perturb_policy::{PolicySpec, SequenceSamples};
use tch::Tensor;

use super::loss::LossTargets;
use super::{Distributions, Sequences, TorchPolicy};
use crate::error::{Error, Result};

/// A rollout or a minibatch: M sequences of L steps. V of these L·M steps are samples, the others are padding.
pub(crate) struct TensorBatch {
    /// The observations and the memory on which the policy is evaluated.
    pub(crate) sequences: Sequences,
    /// `[L, M, A]` actions.
    pub(crate) actions: Tensor,
    /// `[L, M]` log-probabilities of the actions under the policy that acted.
    old_log_probs: Tensor,
    /// `[L, M]` values V that the policy computed when it acted.
    old_values: Tensor,
    /// `[L, M]` advantages.
    advantages: Tensor,
    /// `[L, M]` target values for V.
    returns: Tensor,
    /// `[L, M]` action distributions of the policy that acted; `None` if the loss has no KL divergence.
    acting: Option<Distributions>,
}

impl TensorBatch {
    /// Copies `sequences` into tensors.
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

    /// Returns a minibatch of the sequences at `indices`.
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

    /// Computes and stores the action distributions of the policy that acted: `policy`, with its current weights. The
    /// KL divergence is measured from these distributions.
    pub(crate) fn remember_acting(&mut self, policy: &TorchPolicy) {
        self.acting = Some(policy.distributions(&self.sequences));
    }

    /// Returns the inputs of a loss over the V samples, without padding.
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
