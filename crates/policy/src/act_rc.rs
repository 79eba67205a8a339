//! Acting with a recurrent policy. The equations are in `rc.rs` of `crates/torch`.

use pulp::Simd;

use crate::kernel::{Kernel, Rows, RowsFrom, call, run};
use crate::math::{sigmoid, tanh};
use crate::perceptron::{Forward, Layer, Perceptron, take};
use crate::spec::PolicySpec;

/// A recurrent policy: hidden layers, an LSTM, a policy head and a value head. Also holds the memory of every
/// environment.
#[derive(Clone, Debug)]
pub(crate) struct Recurrent {
    observation_size: usize,
    /// X, the number of inputs that the LSTM gets from the hidden layers.
    hidden_size: usize,
    /// H, the number of units of the LSTM.
    width: usize,
    hidden: Perceptron,
    /// Maps the LSTM's input x and previous output h, `[X + H]`, to the pre-activations of its gates i, f, g and o,
    /// `[4H]`.
    gates: Layer,
    policy: Layer,
    value: Layer,
    /// `[max_batch, 2H]` memory of every environment: the LSTM's output h, then its cell state c.
    memory: Vec<f32>,
    // The remaining fields are buffers with one row for each environment of a batch.
    /// `[max_batch, O]` observations.
    observations: Rows,
    /// Outputs of each hidden layer, one element for each layer.
    hidden_layers: Vec<Rows>,
    /// `[max_batch, X + H]` inputs of the LSTM: x, then the previous output h.
    inputs: Rows,
    /// `[max_batch, 4H]` pre-activations of the LSTM's gates.
    sums: Rows,
    /// `[max_batch, 2H]` memory after the step.
    next: Rows,
    /// `[max_batch, n]` logits or `[max_batch, A]` means.
    outputs: Rows,
    /// `[max_batch, 1]` values V.
    values: Rows,
}

impl Recurrent {
    pub(crate) fn new(spec: &PolicySpec, width: usize, max_batch: usize) -> Self {
        let hidden_size = spec.hidden_size();
        let n_outputs = spec.action.outputs();
        let rows = |length| Rows::new(max_batch, length);
        let hidden = Perceptron::new(&spec.hidden_layers(), true);
        Recurrent {
            observation_size: spec.observation_size,
            hidden_size,
            width,
            hidden_layers: hidden.buffers(max_batch),
            hidden,
            gates: Layer::new(hidden_size + width, 4 * width),
            policy: Layer::new(width, n_outputs),
            value: Layer::new(width, 1),
            memory: vec![0.0; max_batch * 2 * width],
            observations: rows(spec.observation_size),
            inputs: rows(hidden_size + width),
            sums: rows(4 * width),
            next: rows(2 * width),
            outputs: rows(n_outputs),
            values: rows(1),
        }
    }

    /// Loads weights in the order of [`PolicySpec::layout`] from the front of `numbers`, and advances `numbers` past
    /// them.
    pub(crate) fn load(&mut self, numbers: &mut &[f32]) {
        self.hidden.load(numbers);
        self.gates.load_inputs(0, take(numbers, 4 * self.width * self.hidden_size));
        self.gates.load_inputs(self.hidden_size, take(numbers, 4 * self.width * self.width));
        self.gates.load_biases(take(numbers, 4 * self.width));
        self.policy.load(numbers);
        self.value.load(numbers);
    }

    /// Runs the network for environments 0 … `n_envs`-1 and updates their memories. Returns the rows of the policy's
    /// outputs and of the values.
    pub(crate) fn advance(&mut self, observations: &[f32], n_envs: usize) -> (RowsFrom<'_>, RowsFrom<'_>) {
        self.step(observations, 0..n_envs);
        for (n, memory) in self.memory.chunks_exact_mut(2 * self.width).take(n_envs).enumerate() {
            memory.copy_from_slice(&self.next.row(n)[..2 * self.width]);
        }
        (self.outputs.from(0), self.values.from(0))
    }

    /// Runs the network for `observations` of `environments`. Returns the rows of the values, and leaves the memories
    /// unchanged.
    pub(crate) fn values(
        &mut self,
        observations: &[f32],
        environments: impl ExactSizeIterator<Item = usize>,
    ) -> RowsFrom<'_> {
        self.step(observations, environments);
        self.values.from(0)
    }

    pub(crate) fn forget(&mut self, environment: usize) {
        self.memory[environment * 2 * self.width..][..2 * self.width].fill(0.0);
    }

    pub(crate) fn memory(&self) -> &[f32] {
        &self.memory
    }

    /// Returns the memories for writing.
    pub(crate) fn memory_mut(&mut self) -> &mut [f32] {
        &mut self.memory
    }

    /// Computes the fields `next`, `outputs` and `values` from `observations` and the memories of `environments`.
    fn step(&mut self, observations: &[f32], environments: impl ExactSizeIterator<Item = usize>) {
        let n = environments.len();
        self.observations.copy(0, observations, self.observation_size);
        for (row, environment) in environments.enumerate() {
            let memory = &self.memory[environment * 2 * self.width..][..2 * self.width];
            self.inputs.row_mut(row)[self.hidden_size..][..self.width].copy_from_slice(&memory[..self.width]);
            self.next.row_mut(row)[..memory.len()].copy_from_slice(memory);
        }
        run(RecurrentStep { network: self, n });
    }
}

/// The arguments of the vectorised step of `n` environments. The rows of `observations`, `inputs` and `next` must be
/// filled.
struct RecurrentStep<'a> {
    network: &'a mut Recurrent,
    n: usize,
}

impl Kernel for RecurrentStep<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let network = self.network;
        let n = self.n;
        let inputs = &network.observations;
        let outputs = &mut network.hidden_layers[..];
        call(simd, Forward { network: &network.hidden, inputs, rows: 0..n, outputs });
        // Copies x from the last hidden layer into the LSTM's inputs. The inputs already contain the previous outputs
        // h.
        let x = network.hidden_layers.last().unwrap_or(&network.observations);
        for row in 0..n {
            network.inputs.row_mut(row)[..network.hidden_size].copy_from_slice(&x.row(row)[..network.hidden_size]);
        }
        network.gates.apply(simd, &network.inputs, 0..n, &mut network.sums);
        for row in 0..n {
            let (h, c) = network.next.row_mut(row)[..2 * network.width].split_at_mut(network.width);
            cell(&mut network.sums.row_mut(row)[..4 * network.width], h, c);
        }
        network.policy.apply(simd, &network.next, 0..n, &mut network.outputs);
        network.value.apply(simd, &network.next, 0..n, &mut network.values);
    }
}

/// Computes the LSTM of one environment. Replaces the cell states `c` and the outputs `h` by their values after the
/// step. `sums` holds the pre-activations of the gates i, f, g and o, and is overwritten.
#[inline(always)]
fn cell(sums: &mut [f32], h: &mut [f32], c: &mut [f32]) {
    let width = c.len();
    let (input_and_forget, rest) = sums.split_at_mut(2 * width);
    let (candidate, output) = rest.split_at_mut(width);
    input_and_forget.iter_mut().for_each(|x| *x = sigmoid(*x));
    output.iter_mut().for_each(|x| *x = sigmoid(*x));
    candidate.iter_mut().for_each(|x| *x = tanh(*x));
    let (input, forget) = input_and_forget.split_at(width);
    for (((c, f), i), g) in c.iter_mut().zip(forget).zip(input).zip(&*candidate) {
        *c = f * *c + i * g;
    }
    for ((h, o), c) in h.iter_mut().zip(&*output).zip(&*c) {
        *h = o * tanh(*c);
    }
}
