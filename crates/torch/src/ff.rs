//! The feed-forward networks on libtorch.

use tch::Tensor;

use perturb_policy::PolicySpec;

/// Computes a feed-forward policy: two separate multilayer perceptrons with tanh between layers, one for logits or
/// means and one for V(s).
///
/// `leaves` are the weights in the order of [`PolicySpec::layout`]. Returns the policy's outputs, `[B, n]` or `[B, A]`,
/// and the values `[B]` at `observations` `[B, O]`.
pub(super) fn forward(spec: &PolicySpec, leaves: &[Tensor], observations: &Tensor) -> (Tensor, Tensor) {
    let depth = 2 * (spec.hidden.len() + 1);
    let outputs = perceptron(&leaves[..depth], observations, false);
    let values = perceptron(&leaves[depth..2 * depth], observations, false).squeeze_dim(1);
    (outputs, values)
}

/// Computes a multilayer perceptron at `observations` `[B, O]`, with tanh between layers and, if `squash_last`, after
/// the last layer. `leaves` contains the weights and the biases of each layer in turn. Returns the outputs `[B,
/// outputs]`.
pub(super) fn perceptron(leaves: &[Tensor], observations: &Tensor, squash_last: bool) -> Tensor {
    let n_layers = leaves.len() / 2;
    let mut x = observations.shallow_clone();
    for (i, layer) in leaves.chunks_exact(2).enumerate() {
        x = x.linear(&layer[0], Some(&layer[1]));
        if squash_last || i + 1 < n_layers {
            x = x.tanh();
        }
    }
    x
}
