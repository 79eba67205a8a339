//! Acting with the two feed-forward networks.

use crate::kernel::{Rows, run};
use crate::perceptron::{Forward, Perceptron};
use crate::spec::PolicySpec;

/// Two separate perceptrons.
#[derive(Clone, Debug)]
pub(crate) struct Networks {
    /// Gives logits or means.
    pub(crate) policy: Perceptron,
    /// Gives V(s).
    pub(crate) value: Perceptron,
}

/// Them, and what they compute of a batch.
#[derive(Clone, Debug)]
pub(crate) struct FeedForward {
    observation_size: usize,
    networks: Networks,
    // Rows of a batch.
    /// [max_batch, O].
    observations: Rows,
    /// For each layer.
    policy_layers: Vec<Rows>,
    value_layers: Vec<Rows>,
}

impl Networks {
    /// Those of a policy of `spec`, whose weights are 0.
    pub(crate) fn new(spec: &PolicySpec) -> Self {
        let network = |outputs| {
            let mut layers = spec.hidden_layers();
            layers.push((spec.hidden_size(), outputs));
            Perceptron::new(&layers, false)
        };
        Networks { policy: network(spec.action.outputs()), value: network(1) }
    }

    /// Takes over weights in the order of [`PolicySpec::layout`] from the front of `numbers`, which move on.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.policy.load(numbers);
        self.value.load(numbers);
    }
}

impl FeedForward {
    pub(crate) fn new(spec: &PolicySpec, max_batch: usize) -> Self {
        let networks = Networks::new(spec);
        FeedForward {
            observation_size: spec.observation_size,
            observations: Rows::new(max_batch, spec.observation_size),
            policy_layers: networks.policy.room(max_batch),
            value_layers: networks.value.room(max_batch),
            networks,
        }
    }

    pub(crate) fn networks_mut(&mut self) -> &mut Networks {
        &mut self.networks
    }

    /// Rows of the policy's outputs and of the values.
    pub(crate) fn act(&mut self, observations: &[f32], n: usize) -> (&Rows, &Rows) {
        self.values(observations, n);
        let outputs = &mut self.policy_layers;
        run(Forward { network: &self.networks.policy, inputs: &self.observations, n, outputs });
        (&self.policy_layers[self.policy_layers.len() - 1], &self.value_layers[self.value_layers.len() - 1])
    }

    /// Rows of the values.
    pub(crate) fn values(&mut self, observations: &[f32], n: usize) -> &Rows {
        self.observations.copy(observations, self.observation_size);
        let outputs = &mut self.value_layers;
        run(Forward { network: &self.networks.value, inputs: &self.observations, n, outputs });
        &self.value_layers[self.value_layers.len() - 1]
    }
}
