//! A multilayer perceptron, forward and backward.

use pulp::Simd;

use crate::kernel::{Kernel, LANES, Lane, Matrix, Rows, add_outer, add_rows, lanes};

/// A linear layer.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    inputs: usize,
    outputs: usize,
    matrix: Matrix,
    /// [lanes of outputs].
    biases: Vec<Lane>,
}

impl Layer {
    pub(crate) fn new(inputs: usize, outputs: usize) -> Self {
        Layer { inputs, outputs, matrix: Matrix::new(inputs, outputs), biases: vec![[0.0; LANES]; lanes(outputs)] }
    }

    /// Takes over the weights [outputs, their number] of the inputs from `first` on.
    pub(crate) fn load_inputs(&mut self, first: usize, weights: &[f32]) {
        self.matrix.load(first, weights, self.outputs);
    }

    /// Takes over biases `[outputs]`.
    pub(crate) fn load_biases(&mut self, biases: &[f32]) {
        self.biases.as_flattened_mut()[..biases.len()].copy_from_slice(biases);
    }

    /// Takes over weights [outputs, inputs] and biases `[outputs]` from the front of `numbers`, which move on.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.load_inputs(0, take(numbers, self.outputs * self.inputs));
        self.load_biases(take(numbers, self.outputs));
    }

    /// bias + Σ_i input_i weight_i of the first `n` rows, added up in order of i.
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(&self, simd: S, from: &Rows, n: usize, to: &mut Rows) {
        self.matrix.apply(simd, from, n, Some(&self.biases), to);
    }
}

/// Cuts the first `n` of `numbers` off.
pub(crate) fn take<'a>(numbers: &mut &'a [f32], n: usize) -> &'a [f32] {
    let (first, rest) = numbers.split_at(n);
    *numbers = rest;
    first
}

/// Layers with tanh between them.
#[derive(Clone, Debug)]
pub(crate) struct Perceptron {
    layers: Vec<Layer>,
    /// Whether tanh follows the last layer too.
    squash_last: bool,
}

impl Perceptron {
    /// Of layers with these inputs and outputs.
    pub(crate) fn new(layers: &[(usize, usize)], squash_last: bool) -> Self {
        Perceptron {
            layers: layers.iter().map(|&(inputs, outputs)| Layer::new(inputs, outputs)).collect(),
            squash_last,
        }
    }

    /// Room for what the layers give for a batch of `n`.
    pub(crate) fn room(&self, n: usize) -> Vec<Rows> {
        self.layers.iter().map(|layer| Rows::new(n, layer.outputs)).collect()
    }

    /// Takes over the layers' weights and biases, by turns, from the front of `numbers`, which move on.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.layers.iter_mut().for_each(|layer| layer.load(numbers));
    }

    /// Computes every layer's outputs, one of `outputs` each, for the first `n` rows of `inputs`.
    #[inline(always)]
    pub(crate) fn forward<S: Simd>(&self, simd: S, inputs: &Rows, n: usize, outputs: &mut [Rows]) {
        for (i, layer) in self.layers.iter().enumerate() {
            let (below, own) = outputs.split_at_mut(i);
            layer.apply(simd, below.last().unwrap_or(inputs), n, &mut own[0]);
            if self.squash_last || i + 1 < self.layers.len() {
                own[0].squash(n);
            }
        }
    }
}

/// Computes a perceptron's outputs, see [`Perceptron::forward`].
pub(crate) struct Forward<'a> {
    pub(crate) network: &'a Perceptron,
    pub(crate) inputs: &'a Rows,
    pub(crate) n: usize,
    pub(crate) outputs: &'a mut [Rows],
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.network.forward(simd, self.inputs, self.n, self.outputs);
    }
}

/// The derivatives of a sum over samples by a perceptron's weights. Its last layer must be without tanh.
#[derive(Clone, Debug)]
pub(crate) struct Derivatives {
    layers: Vec<LayerDerivatives>,
}

#[derive(Clone, Debug)]
struct LayerDerivatives {
    inputs: usize,
    outputs: usize,
    /// [lanes of inputs, outputs].
    weights: Vec<Lane>,
    /// [lanes of outputs].
    biases: Vec<Lane>,
    /// By this layer's outputs before their tanh, of a batch.
    deltas: Rows,
}

impl Derivatives {
    /// 0, for the weights of `perceptron`, with room for batches of `n`.
    pub(crate) fn new(perceptron: &Perceptron, n: usize) -> Self {
        let of = |layer: &Layer| LayerDerivatives {
            inputs: layer.inputs,
            outputs: layer.outputs,
            weights: vec![[0.0; LANES]; lanes(layer.inputs) * layer.outputs],
            biases: vec![[0.0; LANES]; lanes(layer.outputs)],
            deltas: Rows::new(n, layer.outputs),
        };
        Derivatives { layers: perceptron.layers.iter().map(of).collect() }
    }

    /// Starts a sum.
    pub(crate) fn clear(&mut self) {
        for layer in &mut self.layers {
            layer.weights.fill([0.0; LANES]);
            layer.biases.fill([0.0; LANES]);
        }
    }

    /// By the perceptron's outputs: to be filled before [`Derivatives::add`].
    pub(crate) fn by_outputs(&mut self) -> &mut Rows {
        let last = self.layers.len() - 1;
        &mut self.layers[last].deltas
    }

    /// Adds those of the first `n` rows: `outputs` are what [`Perceptron::forward`] computed of `inputs`.
    #[inline(always)]
    pub(crate) fn add<S: Simd>(&mut self, simd: S, transposed: &Transposed, inputs: &Rows, outputs: &[Rows], n: usize) {
        for i in (0..self.layers.len()).rev() {
            let (below, own) = self.layers.split_at_mut(i);
            let own = &mut own[0];
            let inputs = if i == 0 { inputs } else { &outputs[i - 1] };
            add_outer(simd, &mut own.weights, &own.deltas, own.outputs, inputs, n);
            add_rows(&mut own.biases, &own.deltas, n);
            if let Some(below) = below.last_mut() {
                transposed.0[i - 1].apply(simd, &own.deltas, n, None, &mut below.deltas);
                below.deltas.differentiate_tanh(inputs, n);
            }
        }
    }

    /// Puts them, or adds them, to the front of `gradient`, in the order of the weights; it moves on.
    #[inline(always)]
    fn give<const ADD: bool>(&self, gradient: &mut &mut [f32]) {
        for layer in &self.layers {
            let (weights, rest) = std::mem::take(gradient).split_at_mut(layer.outputs * layer.inputs);
            let (biases, rest) = rest.split_at_mut(layer.outputs);
            *gradient = rest;
            for (column, block) in layer.weights.chunks_exact(layer.outputs).enumerate() {
                for (row, lane) in weights.chunks_exact_mut(layer.inputs).zip(block) {
                    match row[column * LANES..].first_chunk_mut::<LANES>() {
                        Some(whole) => give::<ADD>(whole, lane),
                        None => give::<ADD>(&mut row[column * LANES..], lane),
                    }
                }
            }
            give::<ADD>(biases, layer.biases.as_flattened());
        }
    }
}

/// Replaces `to` by the first numbers of `from`, or adds those.
#[inline(always)]
fn give<const ADD: bool>(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to = if ADD { *to + from } else { *from };
    }
}

/// Adds derivatives to a gradient, or begins it with them.
pub(crate) struct Give<'a, 'b> {
    pub(crate) derivatives: &'a Derivatives,
    pub(crate) gradient: &'a mut &'b mut [f32],
    pub(crate) add: bool,
}

impl Kernel for Give<'_, '_> {
    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Give { derivatives, gradient, add } = self;
        if add { derivatives.give::<true>(gradient) } else { derivatives.give::<false>(gradient) }
    }
}

/// The weights of a perceptron's layers but the first, from outputs to inputs.
#[derive(Clone, Debug)]
pub(crate) struct Transposed(Vec<Matrix>);

impl Transposed {
    pub(crate) fn new(perceptron: &Perceptron) -> Self {
        Transposed(perceptron.layers.iter().skip(1).map(|layer| Matrix::new(layer.outputs, layer.inputs)).collect())
    }

    /// Takes over what [`Perceptron::load`] does.
    pub(crate) fn load(&mut self, perceptron: &Perceptron, mut numbers: &[f32]) {
        for (i, layer) in perceptron.layers.iter().enumerate() {
            let weights = take(&mut numbers, layer.outputs * layer.inputs);
            take(&mut numbers, layer.outputs);
            if i > 0 {
                self.0[i - 1].load_transposed(weights);
            }
        }
    }
}
