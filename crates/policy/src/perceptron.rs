//! The forward and backward pass of a multilayer perceptron.

use std::ops::Range;

use pulp::Simd;

use crate::kernel::{Kernel, LANES, Lane, Rows, lanes};
use crate::product::{Factor, Matrix, outer, sum_rows};

/// A linear layer: weights and biases.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    inputs: usize,
    outputs: usize,
    matrix: Matrix,
    /// The biases of the outputs, padded to whole lanes.
    biases: Vec<Lane>,
}

impl Layer {
    pub(crate) fn new(inputs: usize, outputs: usize) -> Self {
        Layer { inputs, outputs, matrix: Matrix::new(inputs, outputs), biases: vec![[0.0; LANES]; lanes(outputs)] }
    }

    /// Loads `weights` `[outputs, n]` for n inputs, starting at input `first`.
    pub(crate) fn load_inputs(&mut self, first: usize, weights: &[f32]) {
        self.matrix.load(first, weights, self.outputs);
    }

    /// Loads the biases `[outputs]`.
    pub(crate) fn load_biases(&mut self, biases: &[f32]) {
        self.biases.as_flattened_mut()[..biases.len()].copy_from_slice(biases);
    }

    /// Loads weights `[outputs, inputs]` and biases `[outputs]` from the front of `numbers`, and advances `numbers`
    /// past them.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.load_inputs(0, take(numbers, self.outputs * self.inputs));
        self.load_biases(take(numbers, self.outputs));
    }

    /// Computes the outputs bias + Σ_i input_i weight_i for the given `rows` of `from`, and writes them to the same
    /// rows of `to`. Products are added in order of i.
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(&self, simd: S, from: &Rows, rows: Range<usize>, to: &mut Rows) {
        self.matrix.factor().apply_inline(simd, from, rows, Some(&self.biases), to);
    }
}

/// Returns the first `n` of `numbers`, and advances `numbers` past them.
pub(crate) fn take<'a>(numbers: &mut &'a [f32], n: usize) -> &'a [f32] {
    let (first, rest) = numbers.split_at(n);
    *numbers = rest;
    first
}

/// A multilayer perceptron: linear layers with tanh between them.
#[derive(Clone, Debug)]
pub(crate) struct Perceptron {
    layers: Vec<Layer>,
    /// Whether tanh is also applied after the last layer.
    squash_last: bool,
}

impl Perceptron {
    /// Creates a perceptron from pairs (inputs, outputs), one for each layer. All weights are 0.
    pub(crate) fn new(layers: &[(usize, usize)], squash_last: bool) -> Self {
        Perceptron {
            layers: layers.iter().map(|&(inputs, outputs)| Layer::new(inputs, outputs)).collect(),
            squash_last,
        }
    }

    /// Creates buffers for the outputs of all layers, for a batch of `n` rows.
    pub(crate) fn buffers(&self, n: usize) -> Vec<Rows> {
        self.layers.iter().map(|layer| Rows::new(n, layer.outputs)).collect()
    }

    /// Loads the weights and biases of all layers in order from the front of `numbers`, and advances `numbers` past
    /// them.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.layers.iter_mut().for_each(|layer| layer.load(numbers));
    }

    /// Computes the outputs of every layer for the given `rows` of `inputs`. `outputs` has one buffer for each layer.
    #[inline(always)]
    fn forward<S: Simd>(&self, simd: S, inputs: &Rows, rows: Range<usize>, outputs: &mut [Rows]) {
        for (i, layer) in self.layers.iter().enumerate() {
            let (below, own) = outputs.split_at_mut(i);
            layer.apply(simd, below.last().unwrap_or(inputs), rows.clone(), &mut own[0]);
            if self.squash_last || i + 1 < self.layers.len() {
                own[0].squash(rows.clone());
            }
        }
    }
}

/// The arguments of the vectorised forward pass, see [`Perceptron::forward`].
pub(crate) struct Forward<'a> {
    pub(crate) network: &'a Perceptron,
    pub(crate) inputs: &'a Rows,
    pub(crate) rows: Range<usize>,
    pub(crate) outputs: &'a mut [Rows],
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.network.forward(simd, self.inputs, self.rows, self.outputs);
    }
}

/// The backward pass through a perceptron that has no tanh after its last layer.
#[derive(Clone, Debug)]
pub(crate) struct Backward {
    /// P, the number of weights and biases together.
    n_weights: usize,
    layers: Vec<LayerBackward>,
}

#[derive(Clone, Debug)]
struct LayerBackward {
    inputs: usize,
    outputs: usize,
    /// Derivatives of the loss with respect to this layer's outputs before tanh, one row for each sample.
    deltas: Rows,
}

impl Backward {
    /// Creates the backward pass through `perceptron`, with buffers for batches of `n` rows.
    pub(crate) fn new(perceptron: &Perceptron, n: usize) -> Self {
        let backward = |layer: &Layer| LayerBackward {
            inputs: layer.inputs,
            outputs: layer.outputs,
            deltas: Rows::new(n, layer.outputs),
        };
        let layers: Vec<_> = perceptron.layers.iter().map(backward).collect();
        Backward { n_weights: layers.iter().map(LayerBackward::n_weights).sum(), layers }
    }

    /// Returns P, the number of weights and biases together.
    pub(crate) fn n_weights(&self) -> usize {
        self.n_weights
    }

    /// Returns the buffer for the derivatives of the loss with respect to the perceptron's outputs. Fill it before
    /// [`Backward::sum`].
    pub(crate) fn by_outputs(&mut self) -> &mut Rows {
        let last = self.layers.len() - 1;
        &mut self.layers[last].deltas
    }

    /// Computes the derivatives of the loss, summed over the first `n` rows, with respect to `weights` `[P]`. Writes
    /// them to `sums` `[P]`, or adds them to `sums` with `ADD`. `outputs` must be the results of
    /// [`Perceptron::forward`] for `inputs`.
    #[inline(always)]
    pub(crate) fn sum<S: Simd, const ADD: bool>(
        &mut self,
        simd: S,
        mut weights: &[f32],
        mut sums: &mut [f32],
        inputs: &Rows,
        outputs: &[Rows],
        n: usize,
    ) {
        for i in (0..self.layers.len()).rev() {
            let (below, own) = self.layers.split_at_mut(i);
            let LayerBackward { inputs: size, deltas, .. } = &own[0];
            let first = sums.len() - own[0].n_weights();
            let (rest, sums_here) = sums.split_at_mut(first);
            let (by_weights, by_biases) = sums_here.split_at_mut(size * own[0].outputs);
            let inputs = if i == 0 { inputs } else { &outputs[i - 1] };
            outer::<S, ADD>(simd, by_weights, *size, deltas, inputs, n);
            sum_rows::<ADD>(by_biases, deltas, n);
            if let Some(below) = below.last_mut() {
                let matrix = &weights[first..][..by_weights.len()];
                Factor::rows(matrix, *size).apply(simd, deltas, 0..n, None, &mut below.deltas);
                below.deltas.differentiate_tanh(inputs, n);
            }
            (weights, sums) = (&weights[..first], rest);
        }
    }
}

impl LayerBackward {
    fn n_weights(&self) -> usize {
        self.outputs * (self.inputs + 1)
    }
}
