//! A policy on libtorch, with its gradients.

use perturb_policy::{ActionKind, PolicySpec, check_length};
use tch::Tensor;

use super::distribution::{Distributions, categorical, gaussian};

use super::{Sequences, ff, rc};
use crate::error::Result;

/// A policy of either architecture. A feed-forward policy consists of two separate multilayer perceptrons, one for
/// logits or means and one for V(s). A recurrent policy consists of hidden layers, an LSTM and two linear heads. For
/// continuous actions there is one more weight for each element, log_std, which does not depend on the state.
///
/// All weights are stored in one tensor `[P]`; the layers' weights are views of it.
pub struct TorchPolicy {
    spec: PolicySpec,
    /// `[P]` all weights. They are not differentiable, and share their storage with `leaves`.
    all: Tensor,
    /// The weights in the order of [`PolicySpec::layout`], differentiable.
    leaves: Vec<Tensor>,
    /// Whether libtorch's autograd differentiates the LSTM, instead of this crate.
    plain_autograd: bool,
}

/// The results of evaluating a policy at B observations and actions.
#[derive(Debug)]
pub struct Evaluated {
    /// `[B]` log-probabilities (densities, if continuous) of the actions.
    pub log_probs: Tensor,
    /// `[B]` entropies of the action distributions, in nats.
    pub entropy: Tensor,
    /// `[B]` values V of the observations.
    pub values: Tensor,
    /// The action distributions of the B samples.
    pub distributions: Distributions,
    /// Intermediate results of the LSTM, for its gradient; `None` if libtorch differentiates everything.
    tape: Option<rc::Tape>,
}

impl TorchPolicy {
    /// Creates a policy with the given weights `[P]`.
    ///
    /// Sets libtorch to one thread in the whole process. These networks are too small to gain from several threads, and
    /// with one thread sums have a fixed order.
    ///
    /// # Errors
    /// An error if the number of weights is wrong.
    pub fn new(spec: &PolicySpec, weights: &[f32]) -> Result<Self> {
        check_length("weights [P]", weights.len(), spec.n_weights())?;
        tch::set_num_threads(1);
        let all = Tensor::f_of_slice(weights)?;
        let mut leaves = Vec::new();
        let mut start = 0;
        for (_, shape) in spec.layout() {
            let length = shape.iter().product::<usize>() as i64;
            let shape: Vec<i64> = shape.iter().map(|&axis| axis as i64).collect();
            leaves
                .push(all.f_narrow(0, start, length)?.f_view(shape.as_slice())?.f_detach()?.f_set_requires_grad(true)?);
            start += length;
        }
        Ok(TorchPolicy { spec: spec.clone(), all, leaves, plain_autograd: false })
    }

    /// Creates a policy whose weights are all 0.
    pub(crate) fn zeros(spec: &PolicySpec) -> Result<Self> {
        TorchPolicy::new(spec, &vec![0.0; spec.n_weights()])
    }

    /// Makes libtorch's autograd differentiate the LSTM. The results are the same except for rounding, but slower.
    /// Tests compare both.
    pub fn with_plain_autograd(self) -> Self {
        TorchPolicy { plain_autograd: true, ..self }
    }

    /// Returns the shape of the policy.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// Evaluates the policy at all samples of `sequences`: log-probabilities of `actions` `[L, M, A]`, entropies and
    /// values. A discrete action is its index, with A = 1. All results are f32 `[B]` and can be differentiated with
    /// [`TorchPolicy::gradient`].
    ///
    /// A recurrent policy starts from the memory of the sequences, and from 0 at the start of each episode. Nothing is
    /// differentiated with respect to that memory.
    ///
    /// # Panics
    ///
    /// If a shape is wrong, or a discrete action is not in 0 … n-1.
    pub fn evaluate(&self, sequences: &Sequences, actions: &Tensor) -> Evaluated {
        let (outputs, values, tape) = self.forward(sequences);
        let outputs = sequences.without_padding(outputs);
        let values = sequences.without_padding(values);
        let actions = sequences.without_padding(actions.view((-1, self.spec.action.width() as i64)));
        let distributions = self.distributions_of(outputs);
        let (log_probs, entropy) = match &distributions.log_std {
            None => categorical(&distributions.outputs, &actions),
            Some(log_std) => gaussian(&distributions.outputs, log_std, &actions),
        };
        Evaluated { log_probs, entropy, values, distributions, tape }
    }

    /// Returns the action distributions `[L, M]` at all steps of `sequences`, including padding. They are not
    /// differentiable.
    pub(crate) fn distributions(&self, sequences: &Sequences) -> Distributions {
        tch::no_grad(|| {
            let (outputs, _, _) = self.forward(sequences);
            let outputs = outputs.view((sequences.n_steps(), sequences.count(), self.spec.action.outputs() as i64));
            let Distributions { outputs, log_std } = self.distributions_of(outputs);
            // Copies the log standard deviations, because the weights will change.
            Distributions { outputs, log_std: log_std.map(|log_std| log_std.detach().copy()) }
        })
    }

    /// Computes the policy's outputs and values at all L·M steps.
    fn forward(&self, sequences: &Sequences) -> (Tensor, Tensor, Option<rc::Tape>) {
        if self.spec.lstm.is_some() {
            return rc::forward(&self.spec, &self.leaves, sequences, self.plain_autograd);
        }
        let (outputs, values) = ff::forward(&self.spec, &self.leaves, &sequences.flat_observations());
        (outputs, values, None)
    }

    fn distributions_of(&self, outputs: Tensor) -> Distributions {
        let log_std = match self.spec.action {
            ActionKind::Discrete { .. } => None,
            ActionKind::Continuous { .. } => self.leaves.last().map(Tensor::shallow_clone),
        };
        Distributions { outputs, log_std }
    }

    /// Replaces all weights by `weights` `[P]`.
    pub(crate) fn load(&self, weights: &[f32]) -> Result<()> {
        check_length("weights [P]", weights.len(), self.all.numel())?;
        let mut all = self.all.shallow_clone();
        Ok(tch::no_grad(|| all.f_copy_(&Tensor::f_of_slice(weights)?))?)
    }

    /// Computes the gradient of `loss` with respect to the weights and writes it to `gradient` `[P]`. `loss` must have
    /// been computed from `evaluated`, and from nothing else of this policy. This frees libtorch's graph, so an
    /// evaluation has only one gradient.
    pub fn gradient(&self, evaluated: &Evaluated, loss: &Tensor, gradient: &mut [f32]) -> Result<()> {
        check_length("gradient [P]", gradient.len(), self.all.numel())?;
        let gradients = match &evaluated.tape {
            Some(tape) => rc::backward(&self.spec, &self.leaves, loss, tape)?,
            None => Tensor::f_run_backward(&[loss], &self.leaves, false, false)?,
        };
        let flat = gradients
            .iter()
            .map(|part| part.f_reshape([-1i64].as_slice()))
            .collect::<std::result::Result<Vec<_>, _>>()?;
        Ok(Tensor::f_cat(&flat, 0)?.f_copy_data(gradient, gradient.len())?)
    }
}
