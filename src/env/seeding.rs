//! Random streams that are fully determined by the seed, the environment's index, a purpose, and the number of a trial,
//! episode or step.
//!
//! All random numbers come from Philox 4×64-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011).
//! Philox is a function of a key and a counter, without other state. The key is `[seed, environment index]`. The
//! counter is `[block, index, purpose, 0]`, where `block` counts from 1. So numbers do not depend on earlier
//! computations, the thread or the server. NumPy has the same layout, so a few lines of Python reproduce any stream.
//! The arrays must have the type uint64, since lists lose digits of numbers from 2^63 on:
//!
//! ```python
//! key = numpy.array([seed, environment_index], dtype=numpy.uint64)
//! counter = numpy.array([0, index, purpose, 0], dtype=numpy.uint64)
//! numpy.random.Generator(numpy.random.Philox(key=key, counter=counter)).random()
//! ```
//!
//! | purpose | index | draws, in order |
//! |---|---|---|
//! | 0 | trial | for R+E first a number that selects R if it is below ½; then a number u in [0, 1) for each parameter, in the catalogue's order |
//! | 1 | episode | the numbers of the initial state, in the order of the environment's document |
//!
//! Disturbances draw numbers at each step, and each step has its own stream. The counter of a step's stream is `[block,
//! episode, purpose, step]`:
//!
//! | purpose | step | draws, in order |
//! |---|---|---|
//! | 2 | of the action, from 0 | a number; if it is below `action_hold`, the last action acts again |
//! | 3 | of the action, from 0 | a [normal](PhiloxStream::normal) number for each entry of the action |
//! | 4 | of the observation, 0 after a reset | a [normal](PhiloxStream::normal) number for each entry of the observation |
//! | 5 | of the observation, 0 after a reset | a number for each entry of the observation; if it is below `sensor_dropout`, the entry is lost |
//! | 6 | of the action, from 0 | a number; if it is below 1 / `push_interval`, there is a push, whose [direction](PhiloxStream::direction) is drawn next |
//! | 7 | of the action, from 1 | a number; if it is below `change_probability`, the physics change before the step |

/// The purpose of a random stream. Its number is the third word of the Philox counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DrawPurpose {
    /// Drawing the parameters of a trial.
    Parameters = 0,
    /// Drawing the initial state of an episode.
    InitialState = 1,
    /// Choosing the steps at which the last action acts again.
    ActionHold = 2,
    /// Drawing the noise on an action.
    ActionNoise = 3,
    /// Drawing the noise on an observation.
    SensorNoise = 4,
    /// Choosing the lost entries of an observation.
    SensorDropout = 5,
    /// Choosing the steps with a push, and drawing the directions of pushes.
    Push = 6,
    /// Choosing the steps before which the physics change.
    Change = 7,
}

/// The numbers that determine all random numbers of an episode except its parameters. The parameters depend on the
/// trial's number instead of the episode's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Draw {
    /// The seed.
    pub seed: u64,
    /// The environment's index.
    pub environment_index: u32,
    /// The number of the episode, counted from 0 for each environment.
    pub episode_index: u64,
}

const MULTIPLIERS: [u64; 2] = [0xD2E7_470E_E14C_6C93, 0xCA5A_8263_9512_1157];
const WEYL: [u64; 2] = [0x9E37_79B9_7F4A_7C15, 0xBB67_AE85_84CA_A73B];
const ROUNDS: usize = 10;

/// A stream of random numbers from the Philox generator.
#[derive(Debug, Clone)]
pub struct PhiloxStream {
    key: [u64; 2],
    /// The counter of `block`. Its first word is 0 as long as no block was computed.
    counter: [u64; 4],
    /// The last block that was computed: four times 64 random bits.
    block: [u64; 4],
    /// Number of times that 64 bits were drawn or skipped.
    n_drawn: u64,
}

impl PhiloxStream {
    /// Creates the stream of an environment for one purpose. `index` is the number of the trial for
    /// [`DrawPurpose::Parameters`], and the number of the episode for all other purposes.
    #[inline]
    pub fn new(seed: u64, environment_index: u64, purpose: DrawPurpose, index: u64) -> Self {
        Self { key: [seed, environment_index], counter: [0, index, purpose as u64, 0], block: [0; 4], n_drawn: 0 }
    }

    /// Creates the stream for step number `step` of an episode.
    #[inline]
    pub fn at_step(draw: &Draw, purpose: DrawPurpose, step: u32) -> Self {
        let mut stream = Self::new(draw.seed, draw.environment_index.into(), purpose, draw.episode_index);
        stream.counter[3] = step.into();
        stream
    }

    /// Draws 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        let number = self.n_drawn / 4 + 1;
        if self.counter[0] != number {
            self.block = self.block_at(number);
            self.counter[0] = number;
        }
        let bits = self.block[(self.n_drawn % 4) as usize];
        self.n_drawn += 1;
        bits
    }

    /// Skips `n` times 64 random bits without computing them.
    pub fn skip(&mut self, n: usize) {
        self.n_drawn += n as u64;
    }

    /// Returns the next four times 64 random bits without drawing them. Returns `None` if they are not one block.
    #[inline(always)]
    pub(super) fn peek_block(&self) -> Option<[u64; 4]> {
        // `bool::then` would not be inlined.
        if self.n_drawn.is_multiple_of(4) { Some(self.block_at(self.n_drawn / 4 + 1)) } else { None }
    }

    // Inlined, because arguments and result stay in registers then.
    #[inline(always)]
    fn block_at(&self, number: u64) -> [u64; 4] {
        let [_, index, purpose, step] = self.counter;
        philox([number, index, purpose, step], self.key)
    }

    /// Draws a uniform number in [0, 1): the upper 53 of 64 random bits, divided by 2^53.
    pub fn unit(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Draws a uniformly distributed unit vector in the first `n` of three dimensions; its other entries are 0. With
    /// one dimension the first entry is ±1. With two dimensions the angle is drawn. With three dimensions the last
    /// coordinate is drawn first, then the angle about the last axis.
    pub fn direction(&mut self, n: usize) -> [f64; 3] {
        let last = match n {
            1 => return [if self.unit() < 0.5 { -1.0 } else { 1.0 }, 0.0, 0.0],
            2 => 0.0,
            _ => 2.0 * self.unit() - 1.0,
        };
        let (sin, cos) = libm::sincos(std::f64::consts::TAU * self.unit());
        let radius = (1.0 - last * last).sqrt();
        [radius * cos, radius * sin, last]
    }

    /// Draws a uniform number in [low, high).
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

#[inline(always)]
fn philox(mut counter: [u64; 4], mut key: [u64; 2]) -> [u64; 4] {
    for _ in 0..ROUNDS {
        let a = u128::from(MULTIPLIERS[0]) * u128::from(counter[0]);
        let b = u128::from(MULTIPLIERS[1]) * u128::from(counter[2]);
        counter = [(b >> 64) as u64 ^ counter[1] ^ key[0], b as u64, (a >> 64) as u64 ^ counter[3] ^ key[1], a as u64];
        key = [key[0].wrapping_add(WEYL[0]), key[1].wrapping_add(WEYL[1])];
    }
    counter
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Known answers of the generator, each as (counter, key, result). They are the three lines `philox4x64 10` in the
    /// file `tests/kat_vectors` of Random123 (Salmon et al.).
    const KNOWN_ANSWERS: [([u64; 4], [u64; 2], [u64; 4]); 3] = [
        ([0; 4], [0; 2], [0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B]),
        (
            [u64::MAX; 4],
            [u64::MAX; 2],
            [0x87B092C3013FE90B, 0x438C3C67BE8D0224, 0x9CC7D7C69CD777B6, 0xA09CAEBF594F0BA0],
        ),
        (
            [0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89],
            [0x452821E638D01377, 0xBE5466CF34E90C6C],
            [0xA528F45403E61D95, 0x38C72DBD566E9788, 0xA5A1610E72FD18B5, 0x57BD43B5E52B7FE6],
        ),
    ];

    #[test]
    fn philox_gives_the_known_answers_of_random123() {
        for (counter, key, expected) in KNOWN_ANSWERS {
            assert_eq!(philox(counter, key), expected, "counter {counter:x?}, key {key:x?}");
        }
    }
}
