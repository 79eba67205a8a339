//! Independent streams of randomness from one root seed.
//!
//! Each purpose has its own ChaCha8 stream, so that drawing more numbers for one never shifts another: a policy starts
//! from the same weights whatever the number of minibatches.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The purpose of a stream. The number is the ChaCha stream identifier. It must never change, or seeds lose their meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Initial weights.
    Weights = 1,
    /// Order of the samples in PPO's minibatches.
    Minibatches = 2,
    /// Actions in training, and noise on observations.
    Actions = 3,
    /// Actions in testing.
    TestActions = 4,
    /// Seeds of test environments.
    TestEnvironments = 5,
    /// Seeds of the environments of tests that select a configuration.
    SelectionEnvironments = 6,
    /// Resamples of a bootstrap.
    Bootstrap = 16,
}

/// The stream of `seed` for `purpose`.
pub fn stream(seed: u64, purpose: Purpose) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(purpose as u64);
    rng
}

/// The stream of `seed` for `purpose` in one trial of one environment. A trial can thus be replayed without the earlier
/// ones.
pub fn trial_stream(seed: u64, purpose: Purpose, environment_index: u32, trial_index: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&(purpose as u64).to_le_bytes());
    key[16..20].copy_from_slice(&environment_index.to_le_bytes());
    key[24..].copy_from_slice(&trial_index.to_le_bytes());
    ChaCha8Rng::from_seed(key)
}

/// A number drawn uniformly from [0, 1), in steps of 2⁻⁵³.
pub fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
}

/// A standard normal number, by Box and Muller (1958). Uses two draws and keeps no state between calls, so that the next
/// number depends only on the stream's position. Avoids the C library's functions, whose bytes depend on the processor.
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * libm::log(1.0 - uniform(rng))).sqrt();
    radius * libm::cos(std::f64::consts::TAU * uniform(rng))
}
