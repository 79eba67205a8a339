//! What differentiates recurrent policies. This crate does without: a library that can registers itself here.

use std::sync::OnceLock;

use crate::error::{Error, Result};
use crate::losses::Losses;
use crate::objective::Objective;
use crate::samples::SequenceSamples;
use crate::spec::PolicySpec;

/// Computes gradients of recurrent policies of one shape.
pub trait RecurrentDifferentiator {
    /// Takes a copy of `sequences`, to be learned from several times.
    ///
    /// # Errors
    /// Arrays whose lengths do not fit.
    fn batch(&self, sequences: &SequenceSamples<'_>) -> Result<Box<dyn RecurrentBatch>>;
}

/// Sequences that a recurrent policy learns from.
pub trait RecurrentBatch {
    /// N.
    fn count(&self) -> usize;

    /// Takes `weights` `[P]` for those that acted, from which the KL divergence is measured.
    ///
    /// # Errors
    /// Another number of weights.
    fn remember_acting(&mut self, weights: &[f32]) -> Result<()>;

    /// The losses of `objective` with `weights` `[P]` over the `sequences` with these indices, and in `gradient` `[P]` the
    /// derivatives of their total.
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

/// Makes what differentiates recurrent policies of a shape.
pub type MakeRecurrent = fn(&PolicySpec) -> Result<Box<dyn RecurrentDifferentiator>>;

static RECURRENT: OnceLock<MakeRecurrent> = OnceLock::new();

/// Has recurrent policies differentiated by what `make` makes, from now on and in the whole process. The first call counts.
pub fn register_recurrent(make: MakeRecurrent) {
    let _ = RECURRENT.set(make); // another one would give other bytes in mid-training
}

/// Whether recurrent policies can be differentiated in this process.
pub fn has_recurrent() -> bool {
    RECURRENT.get().is_some()
}

/// What differentiates recurrent policies of this shape.
///
/// # Errors
/// [`Error::NoRecurrentGradients`] if nothing is registered; what the library refuses.
pub fn recurrent_differentiator(spec: &PolicySpec) -> Result<Box<dyn RecurrentDifferentiator>> {
    let make = RECURRENT.get().ok_or(Error::NoRecurrentGradients)?;
    make(spec)
}
