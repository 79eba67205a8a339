//! Initial weights of a policy.

use rand_chacha::ChaCha8Rng;

use crate::random::normal;
use crate::spec::PolicySpec;
use crate::weights::{NamedArray, Weights};

/// Gain of the hidden layers. It compensates for the variance that tanh removes.
const HIDDEN_GAIN: f64 = std::f64::consts::SQRT_2;
/// Gain of the policy's output layer. It is small, so that the first actions hardly depend on the observation.
const POLICY_GAIN: f64 = 0.01;
/// Gain of the value network's output layer.
const VALUE_GAIN: f64 = 1.0;
/// Gain of the LSTM. Its input matrix and its recurrent matrix are each orthogonal as a whole, with all four gates
/// together, as in the reference implementation (OpenAI Baselines).
const LSTM_GAIN: f64 = 1.0;

/// Draws the initial weights of a policy: orthogonal matrices. Biases and log standard deviations are 0.
pub fn initial_weights(spec: &PolicySpec, rng: &mut ChaCha8Rng) -> Weights {
    let draw = |(name, shape): (String, Vec<usize>)| {
        let data = match shape[..] {
            [rows, columns] => orthogonal(rows, columns, gain(spec, &name), rng),
            _ => vec![0.0; shape.iter().product()],
        };
        NamedArray { name, shape, data }
    };
    spec.layout().into_iter().map(draw).collect()
}

/// Returns the gain of the weight matrix called `name`.
fn gain(spec: &PolicySpec, name: &str) -> f64 {
    let last = if spec.lstm.is_some() { String::new() } else { format!(".{}", spec.hidden.len()) };
    if name == format!("policy{last}.weight") {
        POLICY_GAIN
    } else if name == format!("value{last}.weight") {
        VALUE_GAIN
    } else if name.starts_with("lstm.") {
        LSTM_GAIN
    } else {
        HIDDEN_GAIN
    }
}

/// Draws a matrix `[rows, columns]` with orthogonal rows of length `gain`, or with orthogonal columns if it has fewer
/// columns than rows. The distribution is uniform over such matrices (Saxe et al., 2014, arXiv:1312.6120). Applies
/// Gram-Schmidt orthogonalisation, in f64, to vectors of normally distributed numbers.
///
/// A second pass of Gram-Schmidt removes the rounding errors of the first pass. The vectors are then orthogonal up to
/// the rounding of the result to f32.
fn orthogonal(rows: usize, columns: usize, gain: f64, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let count = rows.min(columns);
    let length = rows.max(columns);
    let mut vectors: Vec<Vec<f64>> = Vec::with_capacity(count);
    for _ in 0..count {
        let mut vector: Vec<f64> = (0..length).map(|_| normal(rng)).collect();
        for _ in 0..2 {
            for other in &vectors {
                let overlap = dot(&vector, other);
                vector.iter_mut().zip(other).for_each(|(x, y)| *x -= overlap * y);
            }
            let norm = dot(&vector, &vector).sqrt();
            vector.iter_mut().for_each(|x| *x /= norm);
        }
        vectors.push(vector);
    }
    let element = |row: usize, column: usize| if rows <= columns { vectors[row][column] } else { vectors[column][row] };
    (0..rows * columns).map(|i| (gain * element(i / columns, i % columns)) as f32).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};

    #[test]
    fn the_shorter_side_is_orthogonal() {
        for (rows, columns, gain) in [(64, 64, HIDDEN_GAIN), (64, 4, HIDDEN_GAIN), (3, 64, POLICY_GAIN), (1, 64, 1.0)] {
            let weights = orthogonal(rows, columns, gain, &mut stream(1, Purpose::Weights));
            let count = rows.min(columns);
            let length = rows.max(columns);
            let at = |i: usize, k: usize| {
                f64::from(if rows <= columns { weights[i * columns + k] } else { weights[k * columns + i] })
            };
            for i in 0..count {
                for j in 0..count {
                    let product: f64 = (0..length).map(|k| at(i, k) * at(j, k)).sum();
                    let expected = if i == j { gain * gain } else { 0.0 };
                    // Each of at most 64 products of unit vectors' elements has a relative rounding error of 2⁻²³,
                    // times gain².
                    assert!((product - expected).abs() < 3e-7 * gain * gain, "{rows}x{columns} {i} {j}: {product}");
                }
            }
        }
    }
}
