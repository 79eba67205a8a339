//! Layers in plain f32 loops.

use super::NamedArray;
use super::tanh::tanh;

/// Outputs that are computed together: four SSE registers, whose sums do not wait for each other.
const LANES: usize = 16;

/// A multilayer perceptron, tanh between its layers.
#[derive(Clone, Debug)]
pub(super) struct Network {
    layers: Vec<Dense>,
    /// Whether tanh follows the last layer too.
    squash_last: bool,
    /// Inputs and outputs of a layer, by turns.
    scratch: [Vec<f32>; 2],
}

impl Network {
    pub(super) fn new(layers: &[(usize, usize)], squash_last: bool, max_batch: usize) -> Self {
        let widest = layers.iter().map(|&(_, outputs)| padded(outputs)).max().unwrap_or(0);
        Network {
            layers: layers.iter().map(|&(inputs, outputs)| Dense::new(inputs, outputs)).collect(),
            squash_last,
            scratch: [vec![0.0; max_batch * widest], vec![0.0; max_batch * widest]],
        }
    }

    /// The number of layers.
    pub(super) fn depth(&self) -> usize {
        self.layers.len()
    }

    /// Takes over weights and biases, which alternate.
    pub(super) fn load(&mut self, weights: &[NamedArray]) {
        for (layer, arrays) in self.layers.iter_mut().zip(weights.chunks_exact(2)) {
            layer.load(arrays);
        }
    }

    /// The last layer's outputs for `observations` `[N, O]`, in rows of [`padded`] length.
    pub(super) fn forward(&mut self, observations: &[f32], n_envs: usize) -> &[f32] {
        let last = self.layers.len() - 1;
        let [mut inputs, mut outputs] = self.scratch.each_mut().map(Vec::as_mut_slice);
        for (i, layer) in self.layers.iter().enumerate() {
            let (from, stride) =
                if i == 0 { (observations, layer.inputs) } else { (&inputs[..], padded(layer.inputs)) };
            layer.apply(from, stride, n_envs, self.squash_last || i < last, outputs);
            std::mem::swap(&mut inputs, &mut outputs);
        }
        &inputs[..n_envs * padded(self.layers[last].outputs)]
    }
}

/// The next multiple of [`LANES`].
pub(super) fn padded(outputs: usize) -> usize {
    outputs.next_multiple_of(LANES)
}

/// A linear layer. Weights are stored in the order in which they are read: for each group of [`LANES`] outputs, for
/// each input, that input's weights; the last group is filled up with zeros.
#[derive(Clone, Debug)]
pub(super) struct Dense {
    inputs: usize,
    outputs: usize,
    /// [outputs / LANES, inputs, LANES].
    weights: Vec<[f32; LANES]>,
    /// [outputs / LANES, LANES].
    biases: Vec<[f32; LANES]>,
}

impl Dense {
    pub(super) fn new(inputs: usize, outputs: usize) -> Self {
        let groups = padded(outputs) / LANES;
        Dense { inputs, outputs, weights: vec![[0.0; LANES]; groups * inputs], biases: vec![[0.0; LANES]; groups] }
    }

    /// Takes over weights [outputs, inputs] and biases [outputs].
    pub(super) fn load(&mut self, arrays: &[NamedArray]) {
        self.load_inputs(0, &arrays[0].data);
        self.load_biases(&arrays[1].data);
    }

    /// Takes over the weights of some inputs, `first` and those after it: [outputs, their number].
    pub(super) fn load_inputs(&mut self, first: usize, weights: &[f32]) {
        for (o, row) in weights.chunks_exact(weights.len() / self.outputs).enumerate() {
            let group = &mut self.weights[o / LANES * self.inputs + first..];
            group.iter_mut().zip(row).for_each(|(lanes, weight)| lanes[o % LANES] = *weight);
        }
    }

    /// Takes over biases [outputs].
    pub(super) fn load_biases(&mut self, biases: &[f32]) {
        self.biases.as_flattened_mut()[..biases.len()].copy_from_slice(biases);
    }

    /// Computes `n` rows of `outputs`, which are [`padded`], from the first `n` rows of `from`, `stride` apart. Every
    /// output is bias + Σ_i input_i weight_i, added up in order of i. A group's weights serve all rows while they are in
    /// the processor's first cache.
    pub(super) fn apply(&self, from: &[f32], stride: usize, n: usize, squash: bool, outputs: &mut [f32]) {
        let width = padded(self.outputs);
        let outputs = &mut outputs[..n * width];
        for (group, (weights, biases)) in self.weights.chunks_exact(self.inputs).zip(&self.biases).enumerate() {
            let rows = from.chunks_exact(stride).zip(outputs.chunks_exact_mut(width));
            for (inputs, outputs) in rows {
                outputs[group * LANES..][..LANES].copy_from_slice(&weighted_sum(inputs, weights, *biases));
            }
        }
        if squash {
            outputs.iter_mut().for_each(|x| *x = tanh(*x));
        }
    }
}

/// `sums` + Σ_i input_i weights_i. A function of its own, for inlined the compiler does not always vectorise it.
#[inline(never)]
fn weighted_sum(inputs: &[f32], weights: &[[f32; LANES]], mut sums: [f32; LANES]) -> [f32; LANES] {
    for (input, weights) in inputs.iter().zip(weights) {
        for (sum, weight) in sums.iter_mut().zip(weights) {
            *sum += input * weight;
        }
    }
    sums
}
