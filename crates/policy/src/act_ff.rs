//! Acting with the two feed-forward networks.

use std::mem::swap;
use std::ops::Range;

use crate::kernel::{Rows, RowsFrom, run};
use crate::perceptron::{Forward, Perceptron};
use crate::spec::PolicySpec;

/// Samples whose activations are kept at once: those of both networks stay in the processor's second cache.
pub(crate) const BLOCK: usize = 64;

/// Two separate perceptrons.
#[derive(Clone, Debug)]
pub(crate) struct Networks {
    /// Gives logits or means.
    pub(crate) policy: Perceptron,
    /// Gives V(s).
    pub(crate) value: Perceptron,
}

/// What they compute of rows of observations.
#[derive(Clone, Debug)]
pub(crate) struct Activations {
    /// [rows, O].
    pub(crate) observations: Rows,
    /// For each layer.
    pub(crate) policy_layers: Vec<Rows>,
    pub(crate) value_layers: Vec<Rows>,
}

/// Networks that act.
#[derive(Clone, Debug)]
pub(crate) struct FeedForward {
    observation_size: usize,
    networks: Networks,
    activations: Activations,
    /// Rows that may be kept.
    most_kept: usize,
    /// Rows that are: all that was acted on since the weights came. None if that was more, or there are no weights.
    kept: Option<usize>,
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

impl Activations {
    /// Room for those of `networks`, of a policy of `spec`, in so many rows.
    pub(crate) fn new(spec: &PolicySpec, networks: &Networks, rows: usize) -> Self {
        Activations {
            observations: Rows::new(rows, spec.observation_size),
            policy_layers: networks.policy.room(rows),
            value_layers: networks.value.room(rows),
        }
    }
}

impl FeedForward {
    pub(crate) fn new(spec: &PolicySpec, max_batch: usize) -> Self {
        let networks = Networks::new(spec);
        let activations = Activations::new(spec, &networks, max_batch);
        FeedForward { observation_size: spec.observation_size, networks, activations, most_kept: 0, kept: None }
    }

    /// From now on keeps the activations of what is acted on, for [`FeedForward::exchange`], up to [`BLOCK`] rows with those
    /// of values.
    pub(crate) fn keep(&mut self, spec: &PolicySpec) {
        self.most_kept = BLOCK;
        self.activations = Activations::new(spec, &self.networks, BLOCK);
    }

    /// Takes over weights, see [`Networks::load`].
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.networks.load(numbers);
        self.kept = Some(0);
    }

    /// Exchanges its networks for other ones, and if it has kept any, its activations for a [`BLOCK`]; says how many rows.
    /// It must load weights before it acts again.
    pub(crate) fn exchange(&mut self, networks: &mut Networks, activations: &mut Activations) -> usize {
        swap(&mut self.networks, networks);
        let kept = self.kept.take().unwrap_or(0);
        if kept > 0 {
            swap(&mut self.activations, activations);
        }
        kept
    }

    /// Rows of the policy's outputs and of the values.
    pub(crate) fn act(&mut self, observations: &[f32], n: usize) -> (RowsFrom<'_>, RowsFrom<'_>) {
        let rows = self.value_rows(observations, n);
        let (network, Activations { observations, policy_layers, value_layers }) =
            (&self.networks.policy, &mut self.activations);
        run(Forward { network, inputs: observations, rows: rows.clone(), outputs: policy_layers });
        self.kept = self.kept.map(|_| rows.end);
        let last = policy_layers.len() - 1;
        (policy_layers[last].from(rows.start), value_layers[last].from(rows.start))
    }

    /// Rows of the values.
    pub(crate) fn values(&mut self, observations: &[f32], n: usize) -> RowsFrom<'_> {
        let rows = self.value_rows(observations, n);
        let layers = &self.activations.value_layers;
        layers[layers.len() - 1].from(rows.start)
    }

    /// Computes values; says in which rows: behind those that are kept, or, where these leave no room, in their place.
    fn value_rows(&mut self, observations: &[f32], n: usize) -> Range<usize> {
        self.kept = self.kept.filter(|kept| kept + n <= self.most_kept);
        let first = self.kept.unwrap_or(0);
        let rows = first..first + n;
        let (network, activations) = (&self.networks.value, &mut self.activations);
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

    /// How many rows are kept after `steps` steps of `n` environments, each with values of as many observations after it.
    fn kept(keeps: bool, n: usize, steps: usize) -> usize {
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
        let kept = acting.exchange(&mut networks, &mut activations);
        for row in 0..BLOCK {
            let observation = activations.observations.row(row)[0];
            assert_eq!(row < kept, observation == 1.0, "row {row} of {kept} begins with {observation}");
        }
        assert_eq!(acting.exchange(&mut networks, &mut activations), 0, "given once");
        kept
    }

    #[test]
    fn rows_are_kept_where_asked_for_as_long_as_there_is_room_for_all() {
        for (n, steps, expected) in
            [(1, 5, 5), (3, 4, 12), (1, 63, 63), (1, 64, 0), (16, 3, 48), (16, 4, 0), (16, 9, 0)]
        {
            assert_eq!(kept(true, n, steps), expected, "{n} environments, {steps} steps");
            assert_eq!(kept(false, n, steps), 0);
        }
    }
}
