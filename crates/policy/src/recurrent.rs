//! The interface to the gradients of recurrent policies. This crate has none: a library that has them registers itself here.

use std::sync::OnceLock;

use crate::error::{Error, Result};
use crate::losses::Losses;
use crate::objective::Objective;
use crate::samples::SequenceSamples;
use crate::spec::PolicySpec;

/// Computes gradients of recurrent policies of one shape.
pub trait RecurrentDifferentiator {
    /// Copies `sequences`, to be learned from several times.
    ///
    /// # Errors
    /// Arrays whose lengths do not fit.
    fn batch(&self, sequences: &SequenceSamples<'_>) -> Result<Box<dyn RecurrentBatch>>;
}

/// Sequences that a recurrent policy learns from.
pub trait RecurrentBatch {
    /// N, the number of sequences.
    fn count(&self) -> usize;

    /// Stores the distributions of the policy with `weights` `[P]` as those of the policy that acted. The KL divergence is
    /// measured from them.
    ///
    /// # Errors
    /// Another number of weights.
    fn remember_acting(&mut self, weights: &[f32]) -> Result<()>;

    /// Writes the derivatives of the total loss with `weights` `[P]` over the `sequences` with these indices to `gradient`
    /// `[P]`. Returns the losses.
    ///
    /// # Errors
    /// Arrays of other lengths, or what the library refuses.
    fn gradient(
        &self,
        weights: &[f32],
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses>;
}

/// Makes the differentiator of recurrent policies of a shape.
pub type MakeRecurrent = fn(&PolicySpec) -> Result<Box<dyn RecurrentDifferentiator>>;

static RECURRENT: OnceLock<MakeRecurrent> = OnceLock::new();

/// Registers `make` for recurrent policies, in the whole process. Only the first call has an effect.
pub fn register_recurrent(make: MakeRecurrent) {
    let _ = RECURRENT.set(make); // another library would give other bytes in the middle of a training
}

/// Whether recurrent policies can be differentiated in this process.
pub fn has_recurrent() -> bool {
    RECURRENT.get().is_some()
}

/// The differentiator of recurrent policies of this shape.
///
/// # Errors
/// [`Error::NoRecurrentGradients`] if nothing is registered; what the library refuses.
pub fn recurrent_differentiator(spec: &PolicySpec) -> Result<Box<dyn RecurrentDifferentiator>> {
    let make = RECURRENT.get().ok_or(Error::NoRecurrentGradients)?;
    make(spec)
}
