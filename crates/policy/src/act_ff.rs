//! Acting with the two feed-forward networks.

use std::mem::swap;
use std::ops::Range;

use crate::kernel::{Rows, RowsFrom, run};
use crate::perceptron::{Forward, Perceptron};
use crate::spec::PolicySpec;

/// Samples whose activations are held at once: those of both networks fit into the processor's second-level cache.
pub(crate) const BLOCK: usize = 64;

/// Two separate perceptrons.
#[derive(Clone, Debug)]
pub(crate) struct Networks {
    /// Computes logits or means.
    pub(crate) policy: Perceptron,
    /// Computes V(s).
    pub(crate) value: Perceptron,
}

/// The activations of both networks at rows of observations.
#[derive(Clone, Debug)]
pub(crate) struct Activations {
    /// [rows, O].
    pub(crate) observations: Rows,
    /// Outputs of the policy network's layers.
    pub(crate) policy_layers: Vec<Rows>,
    /// Outputs of the value network's layers.
    pub(crate) value_layers: Vec<Rows>,
}

/// Networks that act.
#[derive(Clone, Debug)]
pub(crate) struct FeedForward {
    observation_size: usize,
    networks: Networks,
    activations: Activations,
    /// Maximal number of cached rows.
    max_cached: usize,
    /// Number of cached rows: all observations that were acted on since the weights were loaded. `None` if there were more, or
    /// if there are no weights.
    cached: Option<usize>,
}

impl Networks {
    /// The networks of a policy of `spec`, with weights 0.
    pub(crate) fn new(spec: &PolicySpec) -> Self {
        let network = |outputs| {
            let mut layers = spec.hidden_layers();
            layers.push((spec.hidden_size(), outputs));
            Perceptron::new(&layers, false)
        };
        Networks { policy: network(spec.action.outputs()), value: network(1) }
    }

    /// Loads weights in the order of [`PolicySpec::layout`] from the front of `numbers`, and removes them there.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.policy.load(numbers);
        self.value.load(numbers);
    }
}

impl Activations {
    /// Buffers for the activations of `networks`, of a policy of `spec`, at this number of rows.
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

    /// From now on caches the activations while acting, for [`FeedForward::exchange`]: up to [`BLOCK`] rows, those of values
    /// included.
    pub(crate) fn keep(&mut self, spec: &PolicySpec) {
        self.max_cached = BLOCK;
        self.activations = Activations::new(spec, &self.networks, BLOCK);
    }

    /// Loads weights, see [`Networks::load`].
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.networks.load(numbers);
        self.cached = Some(0);
    }

    /// Swaps the networks for others and, if any rows are cached, the activations for those of a [`BLOCK`]. Returns the number
    /// of cached rows. Weights must be loaded before acting again.
    pub(crate) fn exchange(&mut self, networks: &mut Networks, activations: &mut Activations) -> usize {
        swap(&mut self.networks, networks);
        let cached = self.cached.take().unwrap_or(0);
        if cached > 0 {
            swap(&mut self.activations, activations);
        }
        cached
    }

    /// Computes the rows of the policy's outputs and of the values.
    pub(crate) fn act(&mut self, observations: &[f32], n: usize) -> (RowsFrom<'_>, RowsFrom<'_>) {
        let rows = self.value_rows(observations, n);
        let (network, Activations { observations, policy_layers, value_layers }) =
            (&self.networks.policy, &mut self.activations);
        run(Forward { network, inputs: observations, rows: rows.clone(), outputs: policy_layers });
        self.cached = self.cached.map(|_| rows.end);
        let last = policy_layers.len() - 1;
        (policy_layers[last].from(rows.start), value_layers[last].from(rows.start))
    }

    /// Computes the rows of the values.
    pub(crate) fn values(&mut self, observations: &[f32], n: usize) -> RowsFrom<'_> {
        let rows = self.value_rows(observations, n);
        let layers = &self.activations.value_layers;
        layers[layers.len() - 1].from(rows.start)
    }

    /// Computes values. Returns their rows: behind the cached ones or, if there is no space for them, in place of these.
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

    /// Number of cached rows after `steps` steps of `n` environments, each followed by the values of `n` observations.
    fn cached(keeps: bool, n: usize, steps: usize) -> usize {
        let spec = PolicySpec::feed_forward(O, ActionKind::Discrete { n: 2 });
        let mut acting = FeedForward::new(&spec, n);
        if keeps {
            acting.keep(&spec);
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
        let cached = acting.exchange(&mut networks, &mut activations);
        for row in 0..BLOCK {
            let observation = activations.observations.row(row)[0];
            assert_eq!(row < cached, observation == 1.0, "row {row} of {cached} begins with {observation}");
        }
        assert_eq!(acting.exchange(&mut networks, &mut activations), 0, "given once");
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
