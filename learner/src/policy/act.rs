//! Acting: a policy's forward pass in plain f32 loops.
//!
//! libtorch needs 30 µs for one observation, most of it not arithmetic; these loops need a few. An [`Actor`] gives the
//! same bytes for an observation whatever else is in the batch: each output is a sum in one fixed order.

use rand_chacha::ChaCha8Rng;

use super::distribution::{sample_categorical, sample_gaussian};
use super::tanh::tanh;
use super::{ActionKind, NamedArray, PolicySpec, Weights};
use crate::error::{Error, Result};

/// Outputs that are computed together: four SSE registers, whose sums do not wait for each other.
const LANES: usize = 16;

/// Computes actions, log-probabilities and values. Allocates nothing after its creation for batches of at most
/// `max_batch`, except where the caller's outputs grow.
#[derive(Clone, Debug)]
pub struct Actor {
    spec: PolicySpec,
    max_batch: usize,
    policy: Network,
    value: Network,
    log_std: Vec<f32>,
}

/// What a policy did in N environments.
#[derive(Clone, Debug, PartialEq)]
pub struct Acts {
    /// The kind of the actions.
    pub kind: ActionKind,
    /// [N, A] actions as sampled, not clipped. A discrete action is its index as f32, exact below 2²⁴, with A = 1.
    pub actions: Vec<f32>,
    /// [N] log-probabilities (densities, if continuous) of the actions.
    pub log_probs: Vec<f32>,
    /// [N] values of the observations.
    pub values: Vec<f32>,
}

impl Actor {
    /// An actor for at most `max_batch` observations at a time, with all weights 0 until [`Actor::load`].
    pub fn new(spec: &PolicySpec, max_batch: usize) -> Self {
        let log_std = match spec.action {
            ActionKind::Discrete { .. } => Vec::new(),
            ActionKind::Continuous { size } => vec![0.0; size],
        };
        Actor {
            spec: spec.clone(),
            max_batch,
            policy: Network::new(&spec.policy_layers(), max_batch),
            value: Network::new(&spec.value_layers(), max_batch),
            log_std,
        }
    }

    /// Takes over weights, whose names and shapes must be those of [`PolicySpec::layout`].
    pub fn load(&mut self, weights: &Weights) -> Result<()> {
        self.spec.check(weights)?;
        let depth = 2 * (self.spec.hidden.len() + 1);
        self.policy.load(&weights[..depth]);
        self.value.load(&weights[depth..2 * depth]);
        if let Some(log_std) = weights.get(2 * depth) {
            self.log_std.copy_from_slice(&log_std.data);
        }
        Ok(())
    }

    /// Samples an action for each normalised observation of `observations` [N, O], in order of n; draws from `rng` once
    /// per discrete action and twice per element of a continuous one. Replaces what is in `out`.
    pub fn act(&mut self, observations: &[f32], rng: &mut ChaCha8Rng, out: &mut Acts) -> Result<()> {
        self.values(observations, &mut out.values)?;
        let (n_envs, width, outputs) = (out.values.len(), self.spec.action.width(), self.spec.action.outputs());
        out.kind = self.spec.action;
        out.actions.resize(n_envs * width, 0.0);
        out.log_probs.resize(n_envs, 0.0);
        let head = self.policy.forward(observations, n_envs);
        for (n, head) in head.chunks_exact(padded(outputs)).enumerate() {
            let (head, action) = (&head[..outputs], &mut out.actions[n * width..][..width]);
            let log_prob = match self.spec.action {
                ActionKind::Discrete { .. } => {
                    let (choice, log_prob) = sample_categorical(head, rng);
                    action[0] = choice as f32;
                    log_prob
                }
                ActionKind::Continuous { .. } => sample_gaussian(head, &self.log_std, rng, action),
            };
            if !(log_prob.is_finite() && out.values[n].is_finite()) {
                return Err(Error::PolicyOutput { environment: n });
            }
            out.log_probs[n] = log_prob;
        }
        Ok(())
    }

    /// Values V of the normalised `observations` [N, O]; replaces what is in `out` [N].
    pub fn values(&mut self, observations: &[f32], out: &mut Vec<f32>) -> Result<()> {
        let n_envs = observations.len() / self.spec.observation_size;
        if n_envs * self.spec.observation_size != observations.len() || n_envs > self.max_batch {
            let expected = self.max_batch.min(n_envs) * self.spec.observation_size;
            return Err(Error::Length { name: "observations [N, O]", got: observations.len(), expected });
        }
        out.clear();
        out.extend(self.value.forward(observations, n_envs).chunks_exact(padded(1)).map(|head| head[0]));
        Ok(())
    }
}

impl Acts {
    /// No actions yet, room for `n_envs`.
    pub fn new(kind: ActionKind, n_envs: usize) -> Self {
        Acts {
            kind,
            actions: Vec::with_capacity(n_envs * kind.width()),
            log_probs: Vec::with_capacity(n_envs),
            values: Vec::with_capacity(n_envs),
        }
    }

    /// Replaces `bytes` by the actions as the protocol wants them: little-endian i32 [N], or f32 [N, A].
    pub fn write_bytes(&self, bytes: &mut Vec<u8>) {
        bytes.clear();
        match self.kind {
            ActionKind::Discrete { .. } => {
                bytes.extend(self.actions.iter().flat_map(|&action| (action as i32).to_le_bytes()));
            }
            ActionKind::Continuous { .. } => bytes.extend(self.actions.iter().flat_map(|action| action.to_le_bytes())),
        }
    }
}

/// A multilayer perceptron, tanh between its layers.
#[derive(Clone, Debug)]
struct Network {
    layers: Vec<Dense>,
    /// Inputs and outputs of a layer, by turns.
    scratch: [Vec<f32>; 2],
}

impl Network {
    fn new(layers: &[(usize, usize)], max_batch: usize) -> Self {
        let widest = layers.iter().map(|&(_, outputs)| padded(outputs)).max().unwrap_or(0);
        Network {
            layers: layers.iter().map(|&(inputs, outputs)| Dense::new(inputs, outputs)).collect(),
            scratch: [vec![0.0; max_batch * widest], vec![0.0; max_batch * widest]],
        }
    }

    /// Takes over weights and biases, which alternate.
    fn load(&mut self, weights: &[NamedArray]) {
        for (layer, arrays) in self.layers.iter_mut().zip(weights.chunks_exact(2)) {
            layer.load(&arrays[0].data, &arrays[1].data);
        }
    }

    /// The last layer's outputs for `observations` [N, O], in rows of [`padded`] length.
    fn forward(&mut self, observations: &[f32], n_envs: usize) -> &[f32] {
        let last = self.layers.len() - 1;
        let [mut inputs, mut outputs] = self.scratch.each_mut().map(Vec::as_mut_slice);
        for (i, layer) in self.layers.iter().enumerate() {
            let (from, stride) =
                if i == 0 { (observations, layer.inputs) } else { (&inputs[..], padded(layer.inputs)) };
            layer.apply(from, stride, n_envs, i < last, outputs);
            std::mem::swap(&mut inputs, &mut outputs);
        }
        &inputs[..n_envs * padded(self.layers[last].outputs)]
    }
}

/// The next multiple of [`LANES`].
fn padded(outputs: usize) -> usize {
    outputs.next_multiple_of(LANES)
}

/// A linear layer. Weights are stored in the order in which they are read: for each group of [`LANES`] outputs, for
/// each input, that input's weights; the last group is filled up with zeros.
#[derive(Clone, Debug)]
struct Dense {
    inputs: usize,
    outputs: usize,
    /// [outputs / LANES, inputs, LANES].
    weights: Vec<[f32; LANES]>,
    /// [outputs / LANES, LANES].
    biases: Vec<[f32; LANES]>,
}

impl Dense {
    fn new(inputs: usize, outputs: usize) -> Self {
        let groups = padded(outputs) / LANES;
        Dense { inputs, outputs, weights: vec![[0.0; LANES]; groups * inputs], biases: vec![[0.0; LANES]; groups] }
    }

    /// Takes over `weights` [outputs, inputs] and `biases` [outputs].
    fn load(&mut self, weights: &[f32], biases: &[f32]) {
        for (o, (row, bias)) in weights.chunks_exact(self.inputs).zip(biases).enumerate() {
            let (group, lane) = (o / LANES, o % LANES);
            self.biases[group][lane] = *bias;
            for (i, weight) in row.iter().enumerate() {
                self.weights[group * self.inputs + i][lane] = *weight;
            }
        }
    }

    /// Computes `n` rows of `outputs`, which are [`padded`], from the first `n` rows of `from`, `stride` apart. Every
    /// output is bias + Σ_i input_i weight_i, added up in order of i.
    fn apply(&self, from: &[f32], stride: usize, n: usize, hidden: bool, outputs: &mut [f32]) {
        let rows = from.chunks_exact(stride).zip(outputs.chunks_exact_mut(padded(self.outputs)));
        for (inputs, outputs) in rows.take(n) {
            let groups = self.weights.chunks_exact(self.inputs).zip(&self.biases);
            for ((weights, biases), outputs) in groups.zip(outputs.chunks_exact_mut(LANES)) {
                outputs.copy_from_slice(&weighted_sum(inputs, weights, *biases));
            }
            if hidden {
                outputs.iter_mut().for_each(|x| *x = tanh(*x));
            }
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
