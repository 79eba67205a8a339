//! Acting with the two feed-forward networks.

use crate::kernel::{Rows, run};
use crate::perceptron::{Forward, Perceptron};
use crate::spec::PolicySpec;

/// Two separate perceptrons: one gives logits or means, the other V(s).
#[derive(Clone, Debug)]
pub(crate) struct FeedForward {
    observation_size: usize,
    policy: Perceptron,
    value: Perceptron,
    // Rows of a batch.
    /// [max_batch, O].
    observations: Rows,
    /// For each layer.
    policy_layers: Vec<Rows>,
    value_layers: Vec<Rows>,
}

/// The perceptron of a feed-forward policy that has `outputs`.
pub(crate) fn network(spec: &PolicySpec, outputs: usize) -> Perceptron {
    let mut layers = spec.hidden_layers();
    layers.push((spec.hidden_size(), outputs));
    Perceptron::new(&layers, false)
}

impl FeedForward {
    pub(crate) fn new(spec: &PolicySpec, max_batch: usize) -> Self {
        let (policy, value) = (network(spec, spec.action.outputs()), network(spec, 1));
        FeedForward {
            observation_size: spec.observation_size,
            observations: Rows::new(max_batch, spec.observation_size),
            policy_layers: policy.room(max_batch),
            value_layers: value.room(max_batch),
            policy,
            value,
        }
    }

    /// Takes over weights in the order of [`PolicySpec::layout`] from the front of `numbers`, which move on.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.policy.load(numbers);
        self.value.load(numbers);
    }

    /// Rows of the policy's outputs and of the values.
    pub(crate) fn act(&mut self, observations: &[f32], n: usize) -> (&Rows, &Rows) {
        self.values(observations, n);
        let outputs = &mut self.policy_layers;
        run(Forward { network: &self.policy, inputs: &self.observations, n, outputs });
        (&self.policy_layers[self.policy_layers.len() - 1], &self.value_layers[self.value_layers.len() - 1])
    }

    /// Rows of the values.
    pub(crate) fn values(&mut self, observations: &[f32], n: usize) -> &Rows {
        self.observations.copy(observations, self.observation_size);
        let outputs = &mut self.value_layers;
        run(Forward { network: &self.value, inputs: &self.observations, n, outputs });
        &self.value_layers[self.value_layers.len() - 1]
    }
}
