//! The recurrent network on libtorch, with this crate's own back-propagation through time.
//!
//! The LSTM computes, for step t = 0 … L-1 of each of M sequences, with the last hidden layer's output x_t and the
//! initial memory (h_{-1}, c_{-1}):
//!
//! (h', c') = (h_{t-1}, c_{t-1}), or 0 where an episode starts at t,
//! (i, f, g, o) = W_x x_t + W_h h' + b, four blocks of H rows in PyTorch's order,
//! c_t = σ(f) c' + σ(i) tanh g,
//! h_t = σ(o) tanh c_t.
//!
//! This is the LSTM of Hochreiter and Schmidhuber (1997) with the forget gate of Gers et al. (2000). PyTorch has two
//! biases, of which only the sum matters; this network has one. Two linear heads compute logits or means, and V(s),
//! from h_t.
//!
//! **Two stages.** libtorch's autograd would compute the gradients of W_h and W_x by one product for each step, with
//! only M rows. Instead, the loop over time runs without autograd and stores the gates. Its result h is an input of a
//! separate graph for the heads, and back-propagation through this graph gives the derivatives ∂loss/∂h_t of the heads
//! alone. A second loop, backwards in time, turns them into the derivatives with respect to the gates' pre-activations,
//! D_t = ∂loss/∂(W_x x_t + W_h h' + b). With δ_t = ∂loss/∂h_t + W_hᵀ D_{t+1} and the total derivative e_t = ∂loss/∂c_t:
//!
//! e_t = δ_t σ(o) (1 - tanh² c_t) + e_{t+1} σ(f)_{t+1},
//! D_t = (e_t tanh g σ'(i), e_t c' σ'(f), e_t σ(i) tanh'(g), δ_t tanh c_t σ'(o)).
//!
//! Nothing is propagated back across the start of an episode. The gradient of W_h is then a single product Dᵀ h' over
//! all L·M rows. libtorch computes the gradients of W_x, b and the layers below: they equal the gradients of
//! Σ D · (W_x x + b) with constant D.

use tch::{Kind, Tensor};

use perturb_policy::PolicySpec;

use super::Sequences;
use super::ff::perceptron;
use crate::error::Result;

/// The indices of weights in the order of [`PolicySpec::layout`].
struct WeightIndices {
    /// The index of W_x `[4H, X]`, the LSTM's weights for x. All weights before it belong to hidden layers.
    input: usize,
    /// The index of W_h `[4H, H]`, the LSTM's recurrent weights.
    recurrent: usize,
    /// The index of the LSTM's biases b `[4H]`.
    bias: usize,
    /// The index of the first weight of the heads: weights and biases of the policy head, then of the value head, then
    /// log_std if actions are continuous.
    heads: usize,
}

impl WeightIndices {
    fn new(spec: &PolicySpec) -> Self {
        let input = 2 * spec.hidden.len();
        WeightIndices { input, recurrent: input + 1, bias: input + 2, heads: input + 3 }
    }
}

/// The results of the forward pass that the backward pass needs.
#[derive(Debug)]
pub(super) struct Tape {
    /// The part W_x x + b `[L·M, 4H]` of the gates' pre-activations, differentiable through the layers below.
    driven: Tensor,
    /// The LSTM's outputs h `[L·M, H]`, the input of the heads' graph.
    hidden: Tensor,
    /// The gates σ(i), σ(f), tanh g and σ(o), `[L, M, 4H]`.
    gates: Tensor,
    /// The cell states c `[L, M, H]` after each step.
    cells: Tensor,
    /// The outputs h' `[L, M, H]` before each step.
    hidden_before: Tensor,
    /// The cell states c' `[L, M, H]` before each step.
    cells_before: Tensor,
    /// A mask `[L, M, 1]`: 0 at the start of an episode, else 1.
    keep: Tensor,
}

/// Computes the network over `sequences`. Returns the policy's outputs, `[B, n]` or `[B, A]` with B = L·M, the values
/// `[B]`, and the results for the backward pass. With `plain`, libtorch differentiates everything, and the last result
/// is `None`.
pub(super) fn forward(
    spec: &PolicySpec,
    leaves: &[Tensor],
    sequences: &Sequences,
    plain: bool,
) -> (Tensor, Tensor, Option<Tape>) {
    let places = WeightIndices::new(spec);
    let input = &leaves[places.input];
    let recurrent = &leaves[places.recurrent];
    let x = perceptron(&leaves[..places.input], &sequences.flat_observations(), true);
    let driven = x.linear(input, Some(&leaves[places.bias]));
    let (hidden, tape) = if plain {
        (unrolled(&driven, recurrent, sequences), None)
    } else {
        let tape = tch::no_grad(|| run(driven, &recurrent.detach(), sequences));
        let hidden = tape.hidden.set_requires_grad(true);
        (hidden, Some(tape))
    };
    let heads = &leaves[places.heads..];
    let outputs = hidden.linear(&heads[0], Some(&heads[1]));
    let values = hidden.linear(&heads[2], Some(&heads[3])).squeeze_dim(1);
    (outputs, values, tape)
}

/// Runs the LSTM over all steps and returns its outputs h `[L·M, H]`, which libtorch can differentiate.
fn unrolled(driven: &Tensor, recurrent: &Tensor, sequences: &Sequences) -> Tensor {
    let steps = sequences.n_steps();
    let count = sequences.count();
    let width = recurrent.size()[1];
    let keep = sequences.keep();
    let (mut h, mut c) = sequences.initial_memory(width);
    let driven = driven.view((steps, count, 4 * width));
    let hidden: Vec<Tensor> = (0..steps)
        .map(|t| {
            let keep = keep.select(0, t);
            let sums = driven.select(0, t) + (&h * &keep).linear::<Tensor>(recurrent, None);
            let gates = sums.chunk(4, 1);
            c = &c * keep * gates[1].sigmoid() + gates[0].sigmoid() * gates[2].tanh();
            h = gates[3].sigmoid() * c.tanh();
            h.shallow_clone()
        })
        .collect();
    Tensor::cat(&hidden, 0)
}

/// Runs the LSTM over all steps without autograd, and stores the results for the backward pass.
fn run(driven: Tensor, recurrent: &Tensor, sequences: &Sequences) -> Tape {
    let steps = sequences.n_steps();
    let count = sequences.count();
    let width = recurrent.size()[1];
    let keep = sequences.keep();
    let starts = sequences.steps_with_starts();
    let transposed = recurrent.tr();
    let (mut h, mut c) = sequences.initial_memory(width);
    let gates = driven.detach().copy().view((steps, count, 4 * width));
    let mut hidden = Vec::with_capacity(starts.len());
    let mut hidden_before = Vec::with_capacity(starts.len());
    let mut cells = Vec::with_capacity(starts.len());
    let mut cells_before = Vec::with_capacity(starts.len());
    for (t, &any_start) in (0..steps).zip(&starts) {
        // Clears the memory of sequences in which an episode starts.
        if any_start {
            let keep = keep.select(0, t);
            (h, c) = (h * &keep, c * keep);
        }
        // Computes the gates in place: their pre-activations first, then the nonlinearities.
        let gate = |from: i64, blocks: i64| gates.select(0, t).narrow(1, from * width, blocks * width);
        let _ = gates.select(0, t).addmm_(&h, &transposed);
        let _ = gate(0, 2).sigmoid_();
        let _ = gate(2, 1).tanh_();
        let _ = gate(3, 1).sigmoid_();
        let next = (gate(1, 1) * &c).addcmul_(&gate(0, 1), &gate(2, 1));
        hidden_before.push(std::mem::replace(&mut h, gate(3, 1) * next.tanh()));
        cells_before.push(std::mem::replace(&mut c, next));
        hidden.push(h.shallow_clone());
        cells.push(c.shallow_clone());
    }
    Tape {
        driven,
        hidden: Tensor::cat(&hidden, 0),
        gates,
        cells: Tensor::stack(&cells, 0),
        hidden_before: Tensor::stack(&hidden_before, 0),
        cells_before: Tensor::stack(&cells_before, 0),
        keep,
    }
}

/// Returns the gradients of `loss` with respect to all `leaves`, in order.
pub(super) fn backward(spec: &PolicySpec, leaves: &[Tensor], loss: &Tensor, tape: &Tape) -> Result<Vec<Tensor>> {
    let places = WeightIndices::new(spec);
    let heads: Vec<&Tensor> = leaves[places.heads..].iter().chain([&tape.hidden]).collect();
    let mut of_heads = Tensor::f_run_backward(&[loss], &heads, false, false)?;
    let of_hidden = of_heads.remove(of_heads.len() - 1);

    let (deltas, of_recurrent) = tch::no_grad(|| {
        let deltas = deltas(&leaves[places.recurrent].detach(), &of_hidden, tape);
        let width = tape.hidden.size()[1];
        let of_recurrent = deltas.tr().mm(&tape.hidden_before.view((-1, width)));
        (deltas, of_recurrent)
    });

    let below: Vec<&Tensor> = leaves[..places.recurrent].iter().chain([&leaves[places.bias]]).collect();
    let mut gradients = Tensor::f_run_backward(&[(&tape.driven * deltas).sum(Kind::Float)], &below, false, false)?;
    gradients.insert(places.recurrent, of_recurrent);
    gradients.append(&mut of_heads);
    Ok(gradients)
}

/// Computes D `[L·M, 4H]` from ∂loss/∂h `[L·M, H]`, step by step from the last to the first.
fn deltas(recurrent: &Tensor, of_hidden: &Tensor, tape: &Tape) -> Tensor {
    let [steps, count, width] = [0, 1, 2].map(|axis: usize| tape.cells.size()[axis]);
    let of_hidden = of_hidden.view((steps, count, width));
    let block = |k: i64| tape.gates.narrow(2, k * width, width);
    let i = block(0);
    let f = block(1);
    let g = block(2);
    let o = block(3);
    let tanh_c = tape.cells.tanh();
    let slope = |sigmoid: &Tensor| sigmoid * (1f64 - sigmoid);
    let tanh_slope = |tanh: &Tensor| 1f64 - tanh.square();
    // D_t = factors_t times (e_t, e_t, e_t, δ_t). The loop multiplies in place.
    let factors = [&g * slope(&i), &tape.cells_before * slope(&f), &i * tanh_slope(&g), &tanh_c * slope(&o)];
    let deltas = Tensor::stack(&factors, 2); // [L, M, 4, H]
    let hidden_to_cell = o * tanh_slope(&tanh_c);
    let cell_to_cell = f * &tape.keep;

    let mut later_h = of_hidden.select(0, 0).zeros_like();
    let mut later_c = later_h.zeros_like();
    for t in (0..steps).rev() {
        let of_h = of_hidden.select(0, t) + later_h;
        let of_c = later_c.addcmul(&of_h, &hidden_to_cell.select(0, t));
        let delta = deltas.select(0, t);
        let _ = delta.narrow(1, 0, 3).g_mul_(&of_c.unsqueeze(1));
        let _ = delta.select(1, 3).g_mul_(&of_h);
        later_h = delta.view((count, 4 * width)).mm(recurrent) * tape.keep.select(0, t);
        later_c = of_c * cell_to_cell.select(0, t);
    }
    deltas.view((-1, 4 * width))
}
