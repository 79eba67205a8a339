//! Choice of the gradient backend for a policy.

use crate::act::Actor;
use crate::differentiator::Differentiator;
use crate::error::Result;
use crate::gradient::{GradientBackend, GradientBatch};
use crate::losses::Losses;
use crate::objective::Objective;
use crate::recurrent::{RecurrentDifferentiator, recurrent_differentiator};
use crate::samples::SequenceSamples;
use crate::spec::PolicySpec;

/// Creates the gradient backend for a policy of shape `spec`. A feed-forward policy's backend uses `threads` threads,
/// at least 1; their number does not change the results. A recurrent policy's backend ignores `threads`.
///
/// # Errors
/// [`Error::Threads`](crate::Error::Threads) if the threads cannot be started.
/// [`Error::NoRecurrentGradients`](crate::Error::NoRecurrentGradients) if the policy is recurrent and no library is
/// [registered](crate::register_recurrent).
pub fn gradient_backend(spec: &PolicySpec, threads: usize) -> Result<Box<dyn GradientBackend>> {
    Ok(match spec.lstm {
        None => Box::new(Differentiator::new(spec, threads)?),
        Some(_) => Box::new(RecurrentBackend(recurrent_differentiator(spec)?)),
    })
}

/// The gradient backend of recurrent policies. It caches neither weights nor activations: each call gets the weights
/// again.
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
