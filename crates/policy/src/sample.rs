//! Sampling of actions, with their log-probabilities:
//!
//! - Categorical distribution with logits l_j, j = 0 … n-1: log π(a) = l_a - log Σ_j exp l_j.
//! - Diagonal Gaussian with means μ_i and log standard deviations log σ_i, i = 0 … A-1: log π(a) = -½ Σ_i ((a_i -
//!   μ_i)/σ_i)² - Σ_i log σ_i - ½ A log 2π.
//! - Uniform distribution in a box with centre μ_i and half widths σ_i: log π(a) = -Σ_i log 2σ_i.

use rand_chacha::ChaCha8Rng;

use crate::math::{exp, ln};
use crate::random::{normal, uniform};

/// log 2π.
pub(crate) const LOG_TAU: f32 = 1.837_877_1;

/// Returns the maximum of `logits`, and the sum of exp(l_j - maximum) over all logits l_j. The log-probability of
/// choice j is then l_j - maximum - log sum.
pub(crate) fn greatest_and_total(logits: &[f32]) -> (f32, f32) {
    let greatest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    (greatest, logits.iter().map(|logit| exp(logit - greatest)).sum())
}

/// Samples from the categorical distribution with these `logits`, by inverting its cumulative sum. Takes one number
/// from `rng`. Returns the choice and its log-probability.
pub(crate) fn sample_categorical(logits: &[f32], rng: &mut ChaCha8Rng) -> (usize, f32) {
    let (greatest, total) = greatest_and_total(logits);
    let target = uniform(rng) * f64::from(total);
    let mut choice = logits.len() - 1; // chosen if rounding makes `target` at least the last sum
    let mut sum = 0.0f32;
    for (j, logit) in logits.iter().enumerate() {
        sum += exp(logit - greatest);
        if f64::from(sum) > target {
            choice = j;
            break;
        }
    }
    (choice, logits[choice] - greatest - ln(total))
}

/// Samples an action `[A]` from the Gaussian with `means` `[A]` and log standard deviations `log_std` `[A]`, and writes
/// it to `action`. Takes two numbers from `rng` for each element. Returns the log-density.
pub(crate) fn sample_gaussian(means: &[f32], log_std: &[f32], rng: &mut ChaCha8Rng, action: &mut [f32]) -> f32 {
    let mut log_prob = -0.5 * LOG_TAU * means.len() as f32;
    for ((action, mean), log_std) in action.iter_mut().zip(means).zip(log_std) {
        let noise = normal(rng) as f32;
        *action = mean + exp(*log_std) * noise;
        log_prob -= 0.5 * noise * noise + log_std;
    }
    log_prob
}

/// Samples an action `[A]` uniformly from a box, and writes it to `action`. The box has its centre at `middles` `[A]`,
/// and `log_half` `[A]` are the logarithms of half its widths. Takes one number from `rng` for each element. Returns
/// the log-density.
pub(crate) fn sample_uniform(middles: &[f32], log_half: &[f32], rng: &mut ChaCha8Rng, action: &mut [f32]) -> f32 {
    let mut log_prob = 0.0;
    for ((action, middle), log_half) in action.iter_mut().zip(middles).zip(log_half) {
        *action = middle + exp(*log_half) * (2.0 * uniform(rng) - 1.0) as f32;
        log_prob -= log_half + std::f32::consts::LN_2;
    }
    log_prob
}

#[cfg(test)]
#[allow(clippy::disallowed_methods)] // the test compares with the standard library's functions
mod tests {
    use super::*;
    use crate::random::{Purpose, stream};

    #[test]
    fn uniform_actions_fill_the_box_evenly() {
        let middles = [0.0f32, 3.0];
        let half = [2.0f32, 0.5];
        let draws = 100_000;
        let mut rng = stream(1, Purpose::Actions);
        let mut counts = [[0u32; 10]; 2];
        for _ in 0..draws {
            let mut action = [0.0; 2];
            let log_prob = sample_uniform(&middles, &half.map(ln), &mut rng, &mut action);
            assert!((log_prob + 4.0f32.ln()).abs() < 1e-6, "the area is 4 · 1");
            for i in 0..2 {
                let place = (action[i] - middles[i]) / half[i];
                assert!(place.abs() < 1.000_001, "{action:?}");
                counts[i][((5.0 * (place + 1.0)) as usize).min(9)] += 1;
            }
        }
        // The tolerance is four standard deviations of the number of draws in a tenth of the box: √(draws · 0.1 · 0.9).
        for count in counts.into_iter().flatten() {
            assert!((f64::from(count) - 10_000.0).abs() < 380.0, "{counts:?}");
        }
    }

    #[test]
    fn choices_are_as_frequent_as_their_probabilities() {
        let logits = [0.3f32, -1.2, 1.1];
        let total: f64 = logits.iter().map(|&l| f64::from(l).exp()).sum();
        let mut rng = stream(5, Purpose::Actions);
        let mut counts = [0u32; 3];
        let draws = 100_000;
        for _ in 0..draws {
            let (choice, log_prob) = sample_categorical(&logits, &mut rng);
            counts[choice] += 1;
            let expected = f64::from(logits[choice]) - total.ln();
            assert!((f64::from(log_prob) - expected).abs() < 1e-6, "f32 rounding of numbers up to 4");
        }
        for (count, &logit) in counts.iter().zip(&logits) {
            let p = f64::from(logit).exp() / total;
            // The tolerance is four standard deviations of a binomial share. The seed is fixed.
            let tolerance = 4.0 * (p * (1.0 - p) / f64::from(draws)).sqrt();
            assert!((f64::from(*count) / f64::from(draws) - p).abs() < tolerance, "{counts:?}");
        }
    }

    #[test]
    fn samples_have_the_mean_and_deviation_of_their_gaussian() {
        let means = [0.5f32, -2.0];
        let log_std = [0.3f32, -1.0];
        let mut rng = stream(6, Purpose::Actions);
        let draws = 100_000;
        let mut sums = [0.0; 2];
        let mut squares = [0.0; 2];
        let mut product = 0.0;
        for _ in 0..draws {
            let mut action = [0.0; 2];
            sample_gaussian(&means, &log_std, &mut rng, &mut action);
            let z: [f64; 2] = std::array::from_fn(|i| f64::from(action[i] - means[i]) / f64::from(log_std[i]).exp());
            for i in 0..2 {
                sums[i] += z[i] / f64::from(draws);
                squares[i] += z[i] * z[i] / f64::from(draws);
            }
            product += z[0] * z[1] / f64::from(draws);
        }
        // The tolerances are four standard errors: 1/√draws for a mean and a covariance, √2/√draws for a variance.
        for i in 0..2 {
            assert!(sums[i].abs() < 0.0127 && (squares[i] - 1.0).abs() < 0.018, "{sums:?} {squares:?}");
        }
        assert!(product.abs() < 0.0127, "{product}");
    }
}
