//! Policies on libtorch. A program that trains recurrent policies must [`register`] this crate, which then computes
//! their gradients. For feed-forward policies it is a reference implementation for tests.
#![forbid(unsafe_code)]

mod batch;
mod distribution;
mod error;
mod ff;
#[cfg(test)]
mod fixture;
mod loss;
mod policy;
mod rc;
mod sequences;

use std::rc::Rc;

use perturb_policy::{Losses, Objective, RecurrentBatch, RecurrentDifferentiator, SequenceSamples, register_recurrent};

use batch::TensorBatch;
pub use distribution::Distributions;
pub use error::{Error, Result};
pub use loss::{LossTargets, evaluate};
pub use policy::{Evaluated, TorchPolicy};
pub use sequences::Sequences;

/// Makes this process compute the gradients of recurrent policies with libtorch.
pub fn register() {
    register_recurrent(|spec| Ok(Box::new(TorchDifferentiator(Rc::new(TorchPolicy::zeros(spec)?)))));
}

/// Computes gradients of recurrent policies. All batches share its networks.
struct TorchDifferentiator(Rc<TorchPolicy>);

impl RecurrentDifferentiator for TorchDifferentiator {
    fn batch(&self, sequences: &SequenceSamples<'_>) -> perturb_policy::Result<Box<dyn RecurrentBatch>> {
        let batch = TensorBatch::new(self.0.spec(), sequences)?;
        Ok(Box::new(TorchBatch { networks: Rc::clone(&self.0), batch }))
    }
}

struct TorchBatch {
    networks: Rc<TorchPolicy>,
    batch: TensorBatch,
}

impl RecurrentBatch for TorchBatch {
    fn count(&self) -> usize {
        self.batch.sequences.count() as usize
    }

    fn remember_acting(&mut self, weights: &[f32]) -> perturb_policy::Result<()> {
        self.networks.load(weights)?;
        self.batch.remember_acting(&self.networks);
        Ok(())
    }

    fn gradient(
        &self,
        weights: &[f32],
        sequences: &[u32],
        objective: &Objective,
        gradient: &mut [f32],
    ) -> perturb_policy::Result<Losses> {
        self.networks.load(weights)?;
        let whole = sequences.iter().copied().eq(0..self.count() as u32);
        let part = if whole { None } else { Some(self.batch.select(sequences)?) };
        let batch = part.as_ref().unwrap_or(&self.batch);
        let evaluated = self.networks.evaluate(&batch.sequences, &batch.actions);
        let (total, losses) = evaluate(objective, &evaluated, &batch.targets()?)?;
        self.networks.gradient(&evaluated, &total, gradient)?;
        Ok(losses)
    }
}
