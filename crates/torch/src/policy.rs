//! A policy on libtorch, with its gradients.

use perturb_policy::{ActionKind, PolicySpec, check_length};
use tch::Tensor;

use super::distribution::{Distributions, categorical, gaussian};

use super::{Sequences, ff, rc};
use crate::error::Result;

/// A policy of either architecture: feed-forward, two separate multilayer perceptrons of which one gives logits or means
/// and the other V(s); or recurrent, hidden layers, an LSTM, and two linear heads. Continuous actions have one more weight
/// each, log_std, the same in every state.
///
/// All weights lie in one tensor `[P]`, of which those of the layers are views.
pub struct TorchPolicy {
    spec: PolicySpec,
    /// `[P]`, without gradient; shares its storage with `leaves`.
    all: Tensor,
    /// The weights in order of [`PolicySpec::layout`], with gradients.
    leaves: Vec<Tensor>,
    /// Whether libtorch differentiates the recurrence.
    plain_autograd: bool,
}

/// A policy's view of B observations and actions.
#[derive(Debug)]
pub struct Evaluated {
    /// `[B]` log-probabilities (densities, if continuous) of the actions.
    pub log_probs: Tensor,
    /// `[B]` entropies of the action distributions, in nats.
    pub entropy: Tensor,
    /// `[B]` values.
    pub values: Tensor,
    /// B action distributions.
    pub distributions: Distributions,
    /// The intermediate results for the gradient of a recurrence.
    tape: Option<rc::Tape>,
}

impl TorchPolicy {
    /// A policy with the given weights `[P]`.
    ///
    /// Sets libtorch to one thread, for the whole process: these networks are too small to share, and sums stay in one
    /// order.
    ///
    /// # Errors
    /// Another number of weights.
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

    /// A policy whose weights are all 0.
    pub(crate) fn zeros(spec: &PolicySpec) -> Result<Self> {
        TorchPolicy::new(spec, &vec![0.0; spec.n_weights()])
    }

    /// Leaves the gradient through a recurrence to libtorch, to compare with: the same but for rounding, and slower.
    pub fn with_plain_autograd(self) -> Self {
        TorchPolicy { plain_autograd: true, ..self }
    }

    /// The shape.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// Log-probabilities of `actions` `[L, M, A]` (a discrete action is its index, A = 1), entropies, and values over
    /// `sequences`, all f32 `[B]` and, by [`TorchPolicy::gradient`], differentiable in the weights. A recurrent policy begins with
    /// the sequences' memory, and with none at the start of every episode; nothing flows back to what was before.
    ///
    /// # Panics
    ///
    /// If a shape is another, or a discrete action is not in 0 … n-1.
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

    /// `[L, M]` the action distributions at all steps of `sequences`, padding included, without gradient.
    pub(crate) fn distributions(&self, sequences: &Sequences) -> Distributions {
        tch::no_grad(|| {
            let (outputs, _, _) = self.forward(sequences);
            let outputs = outputs.view((sequences.n_steps(), sequences.count(), self.spec.action.outputs() as i64));
            let Distributions { outputs, log_std } = self.distributions_of(outputs);
            // The deviations are copied, since the weights will change.
            Distributions { outputs, log_std: log_std.map(|log_std| log_std.detach().copy()) }
        })
    }

    /// The policy's outputs and values over all L·M steps.
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

    /// Replaces the weights by `weights` `[P]`.
    pub(crate) fn load(&self, weights: &[f32]) -> Result<()> {
        check_length("weights [P]", weights.len(), self.all.numel())?;
        let mut all = self.all.shallow_clone();
        Ok(tch::no_grad(|| all.f_copy_(&Tensor::f_of_slice(weights)?))?)
    }

    /// Writes the gradient of `loss`, which was computed from `evaluated` and from nothing else of this policy, in the
    /// weights to `gradient` `[P]`. Uses up the graph: there is one gradient an evaluation.
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
