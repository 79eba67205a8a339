//! The interface for computing gradients of recurrent policies. This crate has no implementation: a library that has
//! one registers itself here.

use std::sync::OnceLock;

use crate::error::{Error, Result};
use crate::losses::Losses;
use crate::objective::Objective;
use crate::samples::SequenceSamples;
use crate::spec::PolicySpec;

/// Computes gradients for recurrent policies of one shape.
pub trait RecurrentDifferentiator {
    /// Copies `sequences`, so that several gradients can be computed from them.
    ///
    /// # Errors
    /// An error if an array has the wrong length.
    fn batch(&self, sequences: &SequenceSamples<'_>) -> Result<Box<dyn RecurrentBatch>>;
}

/// Sequences of steps from which a recurrent policy learns.
pub trait RecurrentBatch {
    /// Returns N, the number of sequences.
    fn count(&self) -> usize;

    /// Computes and stores the action distributions of the policy that acted, whose weights are `weights` `[P]`. The KL
    /// divergence is measured from these distributions.
    ///
    /// # Errors
    /// An error if the number of weights is wrong.
    fn remember_acting(&mut self, weights: &[f32]) -> Result<()>;

    /// Computes the gradient of the total loss at `weights` `[P]`, over the `sequences` with these indices. Writes it
    /// to `gradient` `[P]`, and returns the losses.
    ///
    /// # Errors
    /// An error if an array has the wrong length, or if the library reports one.
    fn gradient(
        &self,
        weights: &[f32],
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses>;
}

/// A function that creates the differentiator for recurrent policies of a given shape.
pub type MakeRecurrent = fn(&PolicySpec) -> Result<Box<dyn RecurrentDifferentiator>>;

static RECURRENT: OnceLock<MakeRecurrent> = OnceLock::new();

/// Registers `make` for the whole process. Only the first call has an effect.
pub fn register_recurrent(make: MakeRecurrent) {
    let _ = RECURRENT.set(make); // replacing the library during a training would change its results
}

/// Returns whether a library for the gradients of recurrent policies is registered in this process.
pub fn has_recurrent() -> bool {
    RECURRENT.get().is_some()
}

/// Creates the differentiator for recurrent policies of shape `spec`.
///
/// # Errors
/// [`Error::NoRecurrentGradients`] if no library is registered, or the library's error.
pub fn recurrent_differentiator(spec: &PolicySpec) -> Result<Box<dyn RecurrentDifferentiator>> {
    let make = RECURRENT.get().ok_or(Error::NoRecurrentGradients)?;
    make(spec)
}
