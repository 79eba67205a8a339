//! Random numbers for tests, from a seed that is printed so that a failure can be repeated.

use std::thread;
use std::time::{Duration, SystemTime};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use crate::proxy::{ByteFault, FaultKind};

/// The environment variable that sets the seed.
pub const SEED_VARIABLE: &str = "PERTURB_SEED";

/// A random number generator for tests. The same seed gives the same numbers.
pub struct SeededRng(ChaCha8Rng);

impl Default for SeededRng {
    fn default() -> Self {
        Self::new()
    }
}

impl SeededRng {
    /// Creates a generator with the seed in the environment variable [`SEED_VARIABLE`], or otherwise a seed from the
    /// clock. Prints the seed, so that a failure can be repeated.
    ///
    /// # Panics
    /// If the variable is not a number.
    pub fn new() -> Self {
        let given = std::env::var(SEED_VARIABLE).ok().map(|text| text.parse().expect("PERTURB_SEED must be a number"));
        let clock = || SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |time| time.subsec_nanos());
        let seed = given.unwrap_or_else(|| clock().into());
        println!("{SEED_VARIABLE}={seed} repeats this test");
        Self::from_seed(seed)
    }

    /// Creates a generator with this seed.
    pub fn from_seed(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Returns a random number below `end`, which must be at least 1.
    pub fn below(&mut self, end: u64) -> u64 {
        self.0.next_u64() % end
    }

    /// Sleeps for a random time from `from` to `to` ms.
    pub fn wait(&mut self, from: u64, to: u64) {
        thread::sleep(Duration::from_millis(from + self.below(to - from)));
    }

    /// Returns a random fault of one of these kinds, at a byte before `end`.
    ///
    /// The logarithm of the byte's index is roughly uniform, so early bytes are more likely: a fault in the bytes 100
    /// to 1000 is as likely as one in the bytes 1000 to 10 000. Most negotiation happens in the first bytes of a
    /// connection.
    pub fn fault(&mut self, kinds: &[FaultKind], end: u64) -> ByteFault {
        let kind = kinds[self.below(kinds.len() as u64) as usize];
        let digits = u64::from(end.max(2).ilog2());
        let high = 1 << (1 + self.below(digits));
        ByteFault { at: self.below(high.min(end)) as usize, kind }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_follow_from_the_seed() {
        let faults = |seed| {
            let mut rng = SeededRng::from_seed(seed);
            [(); 50].map(|()| rng.fault(&FaultKind::ALL, 10_000))
        };
        assert_eq!(faults(3), faults(3));
        assert_ne!(faults(3), faults(4));
        assert!(faults(3).iter().all(|fault| fault.at < 10_000));
        assert!(FaultKind::ALL.iter().all(|kind| faults(3).iter().any(|fault| fault.kind == *kind)));
    }
}
