//! A policy that can be trained.

use perturb_files::interrupt::StopFlag;
use perturb_policy::math::exp;
use perturb_policy::random::{Purpose, stream};
use perturb_policy::{
    ActionKind, GradientBackend, NamedArray, Player, PolicySpec, Weights, gradient_backend, initial_weights,
};

use crate::error::Result;

/// A trainable policy of either architecture: its P weights, and the backend that computes gradients.
pub struct TrainablePolicy {
    spec: PolicySpec,
    /// The weights `[P]`, in the order of [`PolicySpec::layout`]. After a change, [`GradientBackend::weights_changed`]
    /// must be called.
    pub(crate) weights: Vec<f32>,
    /// The gradient `[P]` of the last gradient step.
    pub(crate) gradient: Vec<f32>,
    pub(crate) backend: Box<dyn GradientBackend>,
    /// Raised to interrupt long updates.
    pub(crate) stop: StopFlag,
}

/// Buffers for computing gradients of feed-forward policies of one shape. Several policies can share them in turn.
pub struct GradientWorkspace {
    spec: PolicySpec,
    backend: Box<dyn GradientBackend>,
    /// The gradient `[P]`.
    gradient: Vec<f32>,
}

impl TrainablePolicy {
    /// Returns a policy with initial weights, which `seed` determines to the byte. Weights are orthogonal with gain √2
    /// in hidden layers, 0.01 in the policy's last layer, and 1 in the value function's last layer and in the LSTM.
    /// Biases and log standard deviations are 0.
    ///
    /// # Errors
    /// An error if a size in `spec` is 0, or for a recurrent policy without a registered backend.
    pub fn new(spec: PolicySpec, seed: u64) -> Result<Self> {
        spec.validate()?;
        let weights = initial_weights(&spec, &mut stream(seed, Purpose::Weights));
        TrainablePolicy::from_weights(spec, &weights)
    }

    /// Returns a policy with the given weights. Their names and shapes must be those of [`PolicySpec::layout`].
    ///
    /// # Errors
    /// An error if a size in `spec` is 0, if the weights do not fit, or for a recurrent policy without a registered
    /// backend.
    pub fn from_weights(spec: PolicySpec, weights: &Weights) -> Result<Self> {
        spec.validate()?;
        spec.check(weights)?;
        let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.iter().copied()).collect();
        let backend = gradient_backend(&spec, 1)?;
        Ok(TrainablePolicy { spec, gradient: vec![0.0; weights.len()], weights, backend, stop: StopFlag::default() })
    }

    /// Sets the flag that interrupts updates: if `stop` is raised, an update that would still take long ends with an
    /// error.
    pub fn set_stop(&mut self, stop: &StopFlag) {
        self.stop = stop.clone();
    }

    /// Sets the number of threads that compute gradients, at least 1. It does not affect the results. Ignored by
    /// recurrent policies.
    ///
    /// # Errors
    /// An error if threads cannot be started.
    pub fn with_threads(mut self, threads: usize) -> Result<Self> {
        if self.spec.lstm.is_none() {
            self.backend = gradient_backend(&self.spec, threads)?;
        }
        Ok(self)
    }

    /// Returns a new gradient workspace for policies of this shape; `None` for a recurrent policy.
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

    /// Swaps this policy's gradient workspace with `other`. Does nothing if their shapes differ. If policies share a
    /// workspace in turn, its memory stays in the processor's caches.
    pub fn swap_workspace(&mut self, other: &mut GradientWorkspace) {
        if other.spec != self.spec {
            return;
        }
        std::mem::swap(&mut self.backend, &mut other.backend);
        std::mem::swap(&mut self.gradient, &mut other.gradient);
        self.backend.weights_changed();
    }

    /// Takes the networks of a player that acted with the current weights. Their cached activations save a forward pass
    /// in the next update. The player must load weights before it acts again.
    pub fn reuse_activations(&mut self, player: &mut Player) {
        player.give_activations(self.backend.as_mut());
    }

    /// Returns the shape of the policy.
    pub fn spec(&self) -> &PolicySpec {
        &self.spec
    }

    /// Returns the weights `[P]`, in the order of [`PolicySpec::layout`].
    pub fn flat_weights(&self) -> &[f32] {
        &self.weights
    }

    /// Returns a copy of the weights as named arrays.
    pub fn weights(&self) -> Weights {
        let mut rest = &self.weights[..];
        let array = |(name, shape): (String, Vec<usize>)| {
            let (data, others) = rest.split_at(shape.iter().product());
            rest = others;
            NamedArray { name, shape, data: data.to_vec() }
        };
        self.spec.layout().into_iter().map(array).collect()
    }

    /// Copies this policy's weights into `weights`, which must have the same shapes.
    pub fn copy_weights(&self, weights: &mut Weights) {
        let mut rest = &self.weights[..];
        for array in weights {
            let (data, others) = rest.split_at(array.data.len());
            array.data.copy_from_slice(data);
            rest = others;
        }
    }

    /// Returns the log standard deviations of continuous actions, which are the last weights. Empty for discrete
    /// actions.
    fn log_std(&self) -> &[f32] {
        match self.spec.action {
            ActionKind::Discrete { .. } => &[],
            ActionKind::Continuous { size } => &self.weights[self.weights.len() - size..],
        }
    }

    /// Returns the standard deviation of the action distribution, averaged over action dimensions; `None` for discrete
    /// actions.
    pub fn mean_std(&self) -> Option<f64> {
        let log_std = self.log_std();
        let sum = log_std.iter().map(|&x| f64::from(exp(x))).sum::<f64>();
        (!log_std.is_empty()).then(|| sum / log_std.len() as f64)
    }
}
