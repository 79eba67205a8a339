//! The gradient backend of a policy.

use crate::act::Actor;
use crate::differentiator::Differentiator;
use crate::error::Result;
use crate::gradient::{GradientBackend, GradientBatch};
use crate::losses::Losses;
use crate::objective::Objective;
use crate::recurrent::{RecurrentDifferentiator, recurrent_differentiator};
use crate::samples::SequenceSamples;
use crate::spec::PolicySpec;

/// The backend of a policy of shape `spec`. For a feed-forward policy it computes with `threads` threads, at least 1, whose
/// number changes no byte. For a recurrent policy it ignores `threads`.
///
/// # Errors
/// Threads that cannot be started; a recurrent policy in a process without a registered library for recurrent policies.
pub fn gradient_backend(spec: &PolicySpec, threads: usize) -> Result<Box<dyn GradientBackend>> {
    Ok(match spec.lstm {
        None => Box::new(Differentiator::new(spec, threads)?),
        Some(_) => Box::new(RecurrentBackend(recurrent_differentiator(spec)?)),
    })
}

/// The backend of recurrent policies. Each gradient gets the weights anew, so that none are cached.
struct RecurrentBackend(Box<dyn RecurrentDifferentiator>);

impl GradientBackend for RecurrentBackend {
    fn batch<'a>(&self, sequences: &SequenceSamples<'a>) -> Result<GradientBatch<'a>> {
        Ok(GradientBatch::Recurrent(self.0.batch(sequences)?))
    }

    fn remember_acting(&mut self, weights: &[f32], batch: &mut GradientBatch<'_>) -> Result<()> {
        let GradientBatch::Recurrent(batch) = batch else { unreachable!("a feed-forward policy's batch") };
        batch.remember_acting(weights)
    }

    fn gradient(
        &mut self,
        weights: &[f32],
        batch: &GradientBatch<'_>,
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> Result<Losses> {
        let GradientBatch::Recurrent(batch) = batch else { unreachable!("a feed-forward policy's batch") };
        batch.gradient(weights, sequences, objective, gradient)
    }

    fn weights_changed(&mut self) {}

    fn reuse_activations(&mut self, _: &mut Actor) {}
}
