//! Independent streams of random numbers from one seed.
//!
//! Each purpose has its own ChaCha8 stream, so that drawing more numbers for one purpose does not change those of
//! another. For example, a policy's initial weights do not depend on the number of minibatches.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The purpose of a random stream. The value is the ChaCha stream identifier. Never change it: a seed would then give
/// other numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Initial weights.
    Weights = 1,
    /// Order of the samples in PPO's minibatches.
    Minibatches = 2,
    /// Actions in training, and noise that is added to observations.
    Actions = 3,
    /// Actions in testing.
    TestActions = 4,
    /// Seeds of test environments.
    TestEnvironments = 5,
    /// Seeds of environments in tests whose results select a configuration.
    SelectionEnvironments = 6,
    /// Resamples of a statistical bootstrap.
    Bootstrap = 16,
}

/// Returns the random stream of `seed` for `purpose`.
pub fn stream(seed: u64, purpose: Purpose) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(purpose as u64);
    rng
}

/// Returns the random stream of `seed` for `purpose` in one trial of one environment. Because each trial has its own
/// stream, it can be replayed without the trials before it.
pub fn trial_stream(seed: u64, purpose: Purpose, environment_index: u32, trial_index: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&(purpose as u64).to_le_bytes());
    key[16..20].copy_from_slice(&environment_index.to_le_bytes());
    key[24..].copy_from_slice(&trial_index.to_le_bytes());
    ChaCha8Rng::from_seed(key)
}

/// Draws a number uniformly from [0, 1), in steps of 2⁻⁵³.
pub fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
}

/// Draws a number from the standard normal distribution (Box and Muller, 1958). Uses two draws and keeps no state
/// between calls, so the next number depends only on the stream's position. Does not use the C library, whose results
/// depend on the processor.
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * libm::log(1.0 - uniform(rng))).sqrt();
    radius * libm::cos(std::f64::consts::TAU * uniform(rng))
}
