//! A policy that learns.

use perturb_files::interrupt::StopFlag;
use perturb_policy::math::exp;
use perturb_policy::random::{Purpose, stream};
use perturb_policy::{
    ActionKind, GradientBackend, NamedArray, Player, PolicySpec, Weights, gradient_backend, initial_weights,
};

use crate::error::Result;

/// A policy of either architecture: its weights, and the backend that computes their gradient.
pub struct Policy {
    spec: PolicySpec,
    /// `[P]` in the order of [`PolicySpec::layout`]. After a change, [`GradientBackend::weights_changed`] must be called.
    pub(crate) weights: Vec<f32>,
    /// `[P]` of the last step.
    pub(crate) gradient: Vec<f32>,
    pub(crate) backend: Box<dyn GradientBackend>,
    /// Raised when a long update shall be broken off.
    pub(crate) stop: StopFlag,
}

/// Buffers in which gradients of feed-forward policies of one shape are computed.
pub struct GradientWorkspace {
    spec: PolicySpec,
    backend: Box<dyn GradientBackend>,
    /// `[P]`.
    gradient: Vec<f32>,
}

impl Policy {
    /// A policy with initial weights from the stream of `seed`: orthogonal with gain √2 in hidden layers, 0.01 in the
    /// policy's last layer, 1 in the value's last layer and in the LSTM; biases and log_std 0. Same seed, same bytes.
    ///
    /// # Errors
    /// A shape that is empty somewhere.
    pub fn new(spec: PolicySpec, seed: u64) -> Result<Self> {
        spec.validate()?;
        let weights = initial_weights(&spec, &mut stream(seed, Purpose::Weights));
        Policy::from_weights(spec, &weights)
    }

    /// A policy with the given weights, whose names and shapes must be those of [`PolicySpec::layout`].
    ///
    /// # Errors
    /// A shape that is empty somewhere, other weights, or a recurrent policy without a registered backend.
    pub fn from_weights(spec: PolicySpec, weights: &Weights) -> Result<Self> {
        spec.validate()?;
        spec.check(weights)?;
        let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.iter().copied()).collect();
        let backend = gradient_backend(&spec, 1)?;
        Ok(Policy { spec, gradient: vec![0.0; weights.len()], weights, backend, stop: StopFlag::default() })
    }

    /// From now on breaks off updates that would take long after `stop` is raised.
    pub fn set_stop(&mut self, stop: &StopFlag) {
        self.stop = stop.clone();
    }

    /// Computes gradients of feed-forward policies with `threads` threads, at least 1. Their number changes no byte.
    ///
    /// # Errors
    /// Threads that cannot be started.
    pub fn with_threads(mut self, threads: usize) -> Result<Self> {
        if self.spec.lstm.is_none() {
            self.backend = gradient_backend(&self.spec, threads)?;
        }
        Ok(self)
    }

    /// A workspace like the one in which this policy computes gradients; `None` if it is recurrent.
    ///
    /// # Errors
    /// The errors of [`gradient_backend`].
    pub fn workspace(&self) -> Result<Option<GradientWorkspace>> {
        if self.spec.lstm.is_some() {
            return Ok(None);
        }
        let backend = gradient_backend(&self.spec, 1)?;
        Ok(Some(GradientWorkspace { spec: self.spec.clone(), backend, gradient: vec![0.0; self.weights.len()] }))
    }

    /// Swaps in another gradient workspace, if it is of this policy's shape. Policies that share one find it in the processor's
    /// caches.
    pub fn swap_workspace(&mut self, other: &mut GradientWorkspace) {
        if other.spec != self.spec {
            return;
        }
        std::mem::swap(&mut self.backend, &mut other.backend);
        std::mem::swap(&mut self.gradient, &mut other.gradient);
        self.backend.weights_changed();
    }

    /// Takes the networks of a player that acted with the present weights, with their cached activations, to skip a forward
    /// pass. The player must load weights before it acts again.
    pub fn reuse_activations(&mut self, player: &mut Player) {
        player.give_activations(self.backend.as_mut());
    }

    /// The shape.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// `[P]` the weights, in the order of [`PolicySpec::layout`].
    pub fn flat_weights(&self) -> &[f32] {
        &self.weights
    }

    /// A copy of the weights.
    pub fn weights(&self) -> Weights {
        let mut rest = &self.weights[..];
        let array = |(name, shape): (String, Vec<usize>)| {
            let (data, others) = rest.split_at(shape.iter().product());
            rest = others;
            NamedArray { name, shape, data: data.to_vec() }
        };
        self.spec.layout().into_iter().map(array).collect()
    }

    /// Replaces the numbers of `weights`, which are those of a policy of this shape.
    pub fn copy_weights(&self, weights: &mut Weights) {
        let mut rest = &self.weights[..];
        for array in weights {
            let (data, others) = rest.split_at(array.data.len());
            array.data.copy_from_slice(data);
            rest = others;
        }
    }

    /// The log standard deviations of continuous actions, which come last.
    fn log_std(&self) -> &[f32] {
        match self.spec.action {
            ActionKind::Discrete { .. } => &[],
            ActionKind::Continuous { size } => &self.weights[self.weights.len() - size..],
        }
    }

    /// Mean standard deviation of the actions; None for discrete ones.
    pub fn mean_std(&self) -> Option<f64> {
        let log_std = self.log_std();
        let sum = log_std.iter().map(|&x| f64::from(exp(x))).sum::<f64>();
        (!log_std.is_empty()).then(|| sum / log_std.len() as f64)
    }
}
