//! Acting with the recurrent network; the equations are in `rc.rs`.

use super::dense::{Dense, Network, padded};
use super::tanh::tanh;
use super::{PolicySpec, Weights};

/// Hidden layers, an LSTM and two heads, with the memory of every environment.
#[derive(Clone, Debug)]
pub(super) struct Recurrent {
    observation_size: usize,
    /// X: numbers that enter the LSTM from below.
    hidden_size: usize,
    /// H.
    width: usize,
    /// n or A.
    n_outputs: usize,
    /// None without hidden layers.
    hidden: Option<Network>,
    /// From x and h together, `[X + H]`, to i, f, g and o, `[4H]`.
    gates: Dense,
    policy: Dense,
    value: Dense,
    /// [max_batch, 2H]: h, then c, of every environment.
    memory: Vec<f32>,
    // Rows of a batch.
    /// [max_batch, X + H].
    inputs: Vec<f32>,
    /// [max_batch, padded(4H)].
    sums: Vec<f32>,
    /// [max_batch, 2H]: the memory after the step.
    next: Vec<f32>,
    /// [max_batch, padded(n or A)].
    outputs: Vec<f32>,
    /// [max_batch, padded(1)].
    values: Vec<f32>,
}

impl Recurrent {
    pub(super) fn new(spec: &PolicySpec, width: usize, max_batch: usize) -> Self {
        let (hidden_size, n_outputs) = (spec.hidden_size(), spec.action.outputs());
        let rows = |length: usize| vec![0.0; max_batch * length];
        Recurrent {
            observation_size: spec.observation_size,
            hidden_size,
            width,
            n_outputs,
            hidden: (!spec.hidden.is_empty()).then(|| Network::new(&spec.hidden_layers(), true, max_batch)),
            gates: Dense::new(hidden_size + width, 4 * width),
            policy: Dense::new(width, n_outputs),
            value: Dense::new(width, 1),
            memory: rows(2 * width),
            inputs: rows(hidden_size + width),
            sums: rows(padded(4 * width)),
            next: rows(2 * width),
            outputs: rows(padded(n_outputs)),
            values: rows(padded(1)),
        }
    }

    /// Takes over weights in the order of [`PolicySpec::layout`].
    pub(super) fn load(&mut self, weights: &Weights) {
        let below = self.hidden.as_ref().map_or(0, |network| 2 * network.depth());
        let (hidden, lstm) = weights.split_at(below);
        if let Some(network) = &mut self.hidden {
            network.load(hidden);
        }
        self.gates.load_inputs(0, &lstm[0].data);
        self.gates.load_inputs(self.hidden_size, &lstm[1].data);
        self.gates.load_biases(&lstm[2].data);
        self.policy.load(&lstm[3..5]);
        self.value.load(&lstm[5..7]);
    }

    /// One step of environments 0 … `n_envs`-1, which remember it: rows of the policy's outputs and of the values, both
    /// [`padded`].
    pub(super) fn advance(&mut self, observations: &[f32], n_envs: usize) -> (&[f32], &[f32]) {
        self.step(observations, 0..n_envs);
        let changed = n_envs * 2 * self.width;
        self.memory[..changed].copy_from_slice(&self.next[..changed]);
        self.policy.apply(&self.next, 2 * self.width, n_envs, false, &mut self.outputs);
        self.value.apply(&self.next, 2 * self.width, n_envs, false, &mut self.values);
        (&self.outputs[..n_envs * padded(self.n_outputs)], &self.values[..n_envs * padded(1)])
    }

    /// Rows of the values of `observations` in `environments`, [`padded`]; memories stay.
    pub(super) fn values(
        &mut self,
        observations: &[f32],
        environments: impl ExactSizeIterator<Item = usize>,
    ) -> &[f32] {
        let n = environments.len();
        self.step(observations, environments);
        self.value.apply(&self.next, 2 * self.width, n, false, &mut self.values);
        &self.values[..n * padded(1)]
    }

    pub(super) fn forget(&mut self, environment: usize) {
        self.memory[environment * 2 * self.width..][..2 * self.width].fill(0.0);
    }

    pub(super) fn memory(&self) -> &[f32] {
        &self.memory
    }

    /// The same, to be overwritten.
    pub(super) fn memory_mut(&mut self) -> &mut [f32] {
        &mut self.memory
    }

    /// Computes `next` from `observations` and the memories of `environments`.
    fn step(&mut self, observations: &[f32], environments: impl ExactSizeIterator<Item = usize>) {
        let (n, width) = (environments.len(), self.width);
        let (x, stride) = match &mut self.hidden {
            Some(network) => (network.forward(observations, n), padded(self.hidden_size)),
            None => (observations, self.observation_size),
        };
        let rows = self.inputs.chunks_exact_mut(self.hidden_size + width).zip(self.next.chunks_exact_mut(2 * width));
        for ((environment, x), (inputs, next)) in environments.zip(x.chunks_exact(stride)).zip(rows) {
            let memory = &self.memory[environment * 2 * width..][..2 * width];
            inputs[..self.hidden_size].copy_from_slice(&x[..self.hidden_size]);
            inputs[self.hidden_size..].copy_from_slice(&memory[..width]);
            next.copy_from_slice(memory);
        }
        self.gates.apply(&self.inputs, self.hidden_size + width, n, false, &mut self.sums);
        let rows = self.sums.chunks_exact_mut(padded(4 * width)).zip(self.next.chunks_exact_mut(2 * width));
        for (sums, next) in rows.take(n) {
            let (h, c) = next.split_at_mut(width);
            cell(&mut sums[..4 * width], h, c);
        }
    }
}

/// Replaces c' by c and what is in `h` by h; `sums` are i, f, g and o, and serve as room.
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

/// 1/(1 + e⁻ˣ) to 2e-7, absolutely.
#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    0.5 + 0.5 * tanh(0.5 * x)
}
