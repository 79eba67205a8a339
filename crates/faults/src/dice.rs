//! Numbers that follow from a seed.

use std::thread;
use std::time::{Duration, SystemTime};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use crate::line::{Fault, Kind};

/// The variable that gives the seed.
pub const SEED: &str = "PERTURB_SEED";

/// Numbers by chance, the same for the same seed.
pub struct Dice(ChaCha8Rng);

impl Default for Dice {
    fn default() -> Self {
        Self::new()
    }
}

impl Dice {
    /// With the seed that the variable [`SEED`] gives, or one of the moment. It is printed, so that what failed can be
    /// tried again.
    ///
    /// # Panics
    /// If the variable is no number.
    pub fn new() -> Self {
        let given = std::env::var(SEED).ok().map(|text| text.parse().expect("PERTURB_SEED is a number"));
        let moment = || SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |time| time.subsec_nanos());
        let seed = given.unwrap_or_else(|| moment().into());
        println!("{SEED}={seed} has the same chances again");
        Self::of(seed)
    }

    /// With this seed.
    pub fn of(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// A number below `end`, which is at least 1.
    pub fn below(&mut self, end: u64) -> u64 {
        self.0.next_u64() % end
    }

    /// Waits `from` to `to` ms.
    pub fn wait(&mut self, from: u64, to: u64) {
        thread::sleep(Duration::from_millis(from + self.below(to - from)));
    }

    /// One of these faults, before the byte `most`, as likely between 100 and 1000 as between 1000 and 10 000: much is
    /// agreed on in the first bytes.
    pub fn fault(&mut self, kinds: &[Kind], most: u64) -> Fault {
        let kind = kinds[self.below(kinds.len() as u64) as usize];
        let digits = u64::from(most.max(2).ilog2());
        let high = 1 << (1 + self.below(digits));
        Fault { at: self.below(high.min(most)) as usize, kind }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_gives_the_same_faults_again_and_another_gives_others() {
        let faults = |seed| {
            let mut dice = Dice::of(seed);
            [(); 50].map(|()| dice.fault(&Kind::ALL, 10_000))
        };
        assert_eq!(faults(3), faults(3));
        assert_ne!(faults(3), faults(4));
        assert!(faults(3).iter().all(|fault| fault.at < 10_000));
        assert!(Kind::ALL.iter().all(|kind| faults(3).iter().any(|fault| fault.kind == *kind)));
    }
}
