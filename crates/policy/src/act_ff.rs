//! Acting with a feed-forward policy: one network for the policy, one for the value.

use std::mem::swap;
use std::ops::Range;

use crate::kernel::{Rows, RowsFrom, run};
use crate::perceptron::{Forward, Perceptron};
use crate::spec::PolicySpec;

/// Maximal number of samples whose activations are in memory at once. The activations of both networks then fit into
/// the processor's L2 cache.
pub(crate) const BLOCK: usize = 64;

/// The policy network and the value network of a feed-forward policy.
#[derive(Clone, Debug)]
pub(crate) struct Networks {
    /// Computes the logits of discrete actions, or the means of continuous ones.
    pub(crate) policy: Perceptron,
    /// Computes V(s).
    pub(crate) value: Perceptron,
}

/// The inputs and the activations of both networks for a batch of observations, one row for each.
#[derive(Clone, Debug)]
pub(crate) struct Activations {
    /// `[rows, O]` inputs of both networks.
    pub(crate) observations: Rows,
    /// `[rows, layer's width]` outputs of each layer of the policy network.
    pub(crate) policy_layers: Vec<Rows>,
    /// `[rows, layer's width]` outputs of each layer of the value network.
    pub(crate) value_layers: Vec<Rows>,
}

/// The networks of a feed-forward policy that acts, with buffers and a cache for activations.
#[derive(Clone, Debug)]
pub(crate) struct FeedForward {
    observation_size: usize,
    networks: Networks,
    activations: Activations,
    /// Maximal number of rows in the cache; 0 if nothing is cached.
    max_cached: usize,
    /// Number of rows in the cache. The cache has a row for every observation since the weights were loaded. `None` if
    /// there were more than `max_cached` observations, or if no weights are loaded.
    cached: Option<usize>,
}

impl Networks {
    /// Creates the networks of a policy of shape `spec`, with all weights 0.
    pub(crate) fn new(spec: &PolicySpec) -> Self {
        let network = |outputs| {
            let mut layers = spec.hidden_layers();
            layers.push((spec.hidden_size(), outputs));
            Perceptron::new(&layers, false)
        };
        Networks { policy: network(spec.action.outputs()), value: network(1) }
    }

    /// Loads weights in the order of [`PolicySpec::layout`] from the front of `numbers`, and advances `numbers` past
    /// them.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.policy.load(numbers);
        self.value.load(numbers);
    }
}

impl Activations {
    /// Creates buffers for the activations of `networks` at `rows` observations.
    pub(crate) fn new(spec: &PolicySpec, networks: &Networks, rows: usize) -> Self {
        Activations {
            observations: Rows::new(rows, spec.observation_size),
            policy_layers: networks.policy.buffers(rows),
            value_layers: networks.value.buffers(rows),
        }
    }
}

impl FeedForward {
    pub(crate) fn new(spec: &PolicySpec, max_batch: usize) -> Self {
        let networks = Networks::new(spec);
        let activations = Activations::new(spec, &networks, max_batch);
        FeedForward { observation_size: spec.observation_size, networks, activations, max_cached: 0, cached: None }
    }

    /// Turns on the cache of activations, for [`FeedForward::swap_networks`]. It holds up to [`BLOCK`] rows. Each
    /// observation takes one row, even if only its value is computed.
    pub(crate) fn enable_cache(&mut self, spec: &PolicySpec) {
        self.max_cached = BLOCK;
        self.activations = Activations::new(spec, &self.networks, BLOCK);
    }

    /// Loads weights, see [`Networks::load`].
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.networks.load(numbers);
        self.cached = Some(0);
    }

    /// Swaps the networks for `networks`. If any rows are cached, also swaps the activations for `activations`, which
    /// must have [`BLOCK`] rows. Returns the number of cached rows. Weights must be loaded before acting again.
    pub(crate) fn swap_networks(&mut self, networks: &mut Networks, activations: &mut Activations) -> usize {
        swap(&mut self.networks, networks);
        let cached = self.cached.take().unwrap_or(0);
        if cached > 0 {
            swap(&mut self.activations, activations);
        }
        cached
    }

    /// Computes both networks for `n` observations. Returns the rows of the policy's outputs and of the values.
    pub(crate) fn act(&mut self, observations: &[f32], n: usize) -> (RowsFrom<'_>, RowsFrom<'_>) {
        let rows = self.value_rows(observations, n);
        let (network, Activations { observations, policy_layers, value_layers }) =
            (&self.networks.policy, &mut self.activations);
        run(Forward { network, inputs: observations, rows: rows.clone(), outputs: policy_layers });
        self.cached = self.cached.map(|_| rows.end);
        let last = policy_layers.len() - 1;
        (policy_layers[last].from(rows.start), value_layers[last].from(rows.start))
    }

    /// Computes the value network for `n` observations. Returns the rows of the values.
    pub(crate) fn values(&mut self, observations: &[f32], n: usize) -> RowsFrom<'_> {
        let rows = self.value_rows(observations, n);
        let layers = &self.activations.value_layers;
        layers[layers.len() - 1].from(rows.start)
    }

    /// Computes the value network for `n` observations. Returns the range of rows with the results: after the cached
    /// rows, or from row 0 if the cache is full.
    fn value_rows(&mut self, observations: &[f32], n: usize) -> Range<usize> {
        self.cached = self.cached.filter(|cached| cached + n <= self.max_cached);
        let first = self.cached.unwrap_or(0);
        let rows = first..first + n;
        let network = &self.networks.value;
        let activations = &mut self.activations;
        activations.observations.copy(first, observations, self.observation_size);
        let Activations { observations, value_layers, .. } = activations;
        run(Forward { network, inputs: observations, rows: rows.clone(), outputs: value_layers });
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};
    use crate::{ActionKind, initial_weights};

    const O: usize = 3;

    /// Returns the number of cached rows after `steps` steps of `n` environments, each followed by the values of `n`
    /// observations.
    fn cached(keeps: bool, n: usize, steps: usize) -> usize {
        let spec = PolicySpec::feed_forward(O, ActionKind::Discrete { n: 2 });
        let mut acting = FeedForward::new(&spec, n);
        if keeps {
            acting.enable_cache(&spec);
        }
        let weights = initial_weights(&spec, &mut stream(1, Purpose::Weights));
        let weights: Vec<f32> = weights.iter().flat_map(|array| array.data.clone()).collect();
        acting.load(&mut &weights[..]);
        for _ in 0..steps {
            acting.act(&vec![1.0; n * O], n);
            acting.values(&vec![2.0; n * O], n);
        }
        let mut networks = Networks::new(&spec);
        let mut activations = Activations::new(&spec, &networks, BLOCK);
        let cached = acting.swap_networks(&mut networks, &mut activations);
        for row in 0..BLOCK {
            let observation = activations.observations.row(row)[0];
            assert_eq!(row < cached, observation == 1.0, "row {row} of {cached} begins with {observation}");
        }
        assert_eq!(acting.swap_networks(&mut networks, &mut activations), 0, "given once");
        cached
    }

    #[test]
    fn rows_are_cached_as_long_as_all_fit() {
        for (n, steps, expected) in
            [(1, 5, 5), (3, 4, 12), (1, 63, 63), (1, 64, 0), (16, 3, 48), (16, 4, 0), (16, 9, 0)]
        {
            assert_eq!(cached(true, n, steps), expected, "{n} environments, {steps} steps");
            assert_eq!(cached(false, n, steps), 0);
        }
    }
}
