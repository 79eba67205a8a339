//! What an update learns from, as tensors.

use tch::Tensor;

use crate::error::{Error, Result};
use crate::policy::{Distributions, Policy, Sequences};
use crate::rollout::{Estimates, Rollout};

/// A rollout, or a minibatch of it: M sequences of L steps. Arrays `[V]` are over its V samples in order, those of
/// padding left out.
pub(super) struct Batch {
    /// What the policy is evaluated on.
    pub(super) sequences: Sequences,
    /// `[L, M, A]`.
    pub(super) actions: Tensor,
    /// `[L, M]`.
    old_log_probs: Tensor,
    /// `[L, M]`.
    old_values: Tensor,
    /// `[L, M]`.
    advantages: Tensor,
    /// `[L, M]`.
    returns: Tensor,
    /// The acting policy's distributions, `[L, M]` of them, where they count.
    acting: Option<Distributions>,
}

impl Batch {
    /// All of a rollout, with what was estimated from it.
    pub(super) fn new(rollout: &Rollout, policy: &Policy, estimates: &Estimates) -> Result<Self> {
        let spec = policy.spec();
        let sequences =
            Sequences::new(spec, rollout.n_steps(), rollout.observations(), rollout.starts(), rollout.memory())?;
        let sequences = match rollout.lengths() {
            Some(lengths) if spec.lstm.is_some() => sequences.with_lengths(lengths)?,
            _ => sequences,
        };
        let (n_steps, count) = (sequences.n_steps(), sequences.count());
        let shaped = |data: &[f32]| Tensor::f_of_slice(data)?.f_view((n_steps, count));
        let batch = Batch {
            actions: Tensor::f_of_slice(rollout.actions())?.f_view((n_steps, count, spec.action.width() as i64))?,
            old_log_probs: shaped(rollout.log_probs())?,
            old_values: shaped(rollout.values())?,
            advantages: shaped(&estimates.advantages)?,
            returns: shaped(&estimates.returns)?,
            acting: None,
            sequences,
        };
        match rollout.samples() {
            // Without memory every sample is a sequence: padding can be left out at once.
            Some(samples) if spec.lstm.is_none() => batch.select(&samples),
            _ => Ok(batch),
        }
    }

    /// The sequences at `indices`.
    pub(super) fn select(&self, indices: &[i64]) -> Result<Self> {
        let indices = Tensor::f_of_slice(indices)?;
        let select = |tensor: &Tensor| Ok::<_, Error>(tensor.f_index_select(1, &indices)?);
        Ok(Batch {
            sequences: self.sequences.select(&indices)?,
            actions: select(&self.actions)?,
            old_log_probs: select(&self.old_log_probs)?,
            old_values: select(&self.old_values)?,
            advantages: select(&self.advantages)?,
            returns: select(&self.returns)?,
            acting: self.acting.as_ref().map(|acting| acting.map(select)).transpose()?,
        })
    }

    /// Takes `policy` as it is for the acting one, from which the KL divergence is measured.
    pub(super) fn remember_acting(&mut self, policy: &Policy) {
        self.acting = Some(policy.distributions(&self.sequences));
    }

    /// The acting policy's distributions, `[V]` of them, if they were remembered.
    pub(super) fn acting(&self) -> Result<Option<Distributions>> {
        self.acting.as_ref().map(|acting| acting.map(|outputs| self.sequences.samples(outputs))).transpose()
    }

    /// Log-probabilities under the acting policy `[V]`.
    pub(super) fn old_log_probs(&self) -> Result<Tensor> {
        self.sequences.samples(&self.old_log_probs)
    }

    /// Values of the acting policy `[V]`.
    pub(super) fn old_values(&self) -> Result<Tensor> {
        self.sequences.samples(&self.old_values)
    }

    /// Advantages `[V]`.
    pub(super) fn advantages(&self) -> Result<Tensor> {
        self.sequences.samples(&self.advantages)
    }

    /// Value targets `[V]`.
    pub(super) fn returns(&self) -> Result<Tensor> {
        self.sequences.samples(&self.returns)
    }
}
