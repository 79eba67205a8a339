//! Random streams that depend on nothing but their address.
//!
//! Every draw comes from Philox 4×64-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011), a
//! function of a key and a counter with no other state. The key is `[seed, environment index]`, the counter
//! `[block, index, purpose, 0]`, with `block` counting from 1. So numbers do not depend on what ran before, or on the
//! thread or server. The layout is that of NumPy, so a few lines of Python repeat any stream (the arrays must be of type uint64:
//! lists lose digits of words from 2^63 on):
//!
//! ```python
//! key = numpy.array([seed, environment_index], dtype=numpy.uint64)
//! counter = numpy.array([0, index, purpose, 0], dtype=numpy.uint64)
//! numpy.random.Generator(numpy.random.Philox(key=key, counter=counter)).random()
//! ```
//!
//! | purpose | index | draws, in order |
//! |---|---|---|
//! | 0 | trial | for R+E first a number, below ½ for R; then one number u in [0, 1) for each parameter, in the catalogue's order |
//! | 1 | episode | the initial state's numbers, in the order of the environment's document |
//!
//! Disturbances draw at each step. Their streams have the number of steps that the episode has taken in the last word of
//! the counter, `[block, episode, purpose, step]`, so that a step's numbers do not depend on those of the steps before:
//!
//! | purpose | step | draws, in order |
//! |---|---|---|
//! | 2 | of the action, from 0 | one below `action_hold` to keep the last action |
//! | 3 | of the action, from 0 | a [normal](Stream::normal) number for each entry of the action |
//! | 4 | of the observation, 0 after a reset | a [normal](Stream::normal) number for each entry of the observation |
//! | 5 | of the observation, 0 after a reset | for each entry of the observation one below `sensor_dropout` to lose it |
//! | 6 | of the action, from 0 | one below 1 / `push_interval` to push, then those of the [direction](Stream::direction) |
//! | 7 | of the action, from 1 | one below `change_probability` to change the physics before it |

/// The purpose of a stream: the third word of the counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// A trial's parameters.
    Parameters = 0,
    /// An episode's initial state.
    InitialState = 1,
    /// The choice of steps at which an action is held.
    ActionHold = 2,
    /// Noise on an action.
    ActionNoise = 3,
    /// Noise on an observation.
    SensorNoise = 4,
    /// The choice of an observation's entries that are lost.
    SensorDropout = 5,
    /// The steps with a push, and the directions of pushes.
    Push = 6,
    /// The steps between which the physics change.
    Change = 7,
}

/// The address of an episode's random numbers. With the distributions it determines all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Draw {
    /// The seed.
    pub seed: u64,
    /// The environment's index.
    pub environment_index: u32,
    /// The index of the current episode.
    pub episode_index: u64,
}

const MULTIPLIERS: [u64; 2] = [0xD2E7_470E_E14C_6C93, 0xCA5A_8263_9512_1157];
const WEYL: [u64; 2] = [0x9E37_79B9_7F4A_7C15, 0xBB67_AE85_84CA_A73B];
const ROUNDS: usize = 10;

/// A stream of uniform numbers.
#[derive(Debug, Clone)]
pub struct Stream {
    key: [u64; 2],
    counter: [u64; 4],
    block: [u64; 4],
    used: usize,
}

impl Stream {
    /// The stream of environment `environment_index` for its trial or episode number `index`.
    pub fn new(seed: u64, environment_index: u64, purpose: Purpose, index: u64) -> Self {
        Self { key: [seed, environment_index], counter: [0, index, purpose as u64, 0], block: [0; 4], used: 4 }
    }

    /// The stream of an episode for its step number `step`.
    pub fn at_step(draw: &Draw, purpose: Purpose, step: u32) -> Self {
        let mut stream = Self::new(draw.seed, draw.environment_index.into(), purpose, draw.episode_index);
        stream.counter[3] = step.into();
        stream
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        if self.used == self.block.len() {
            self.counter[0] += 1; // 2^64 blocks: no episode gets there
            self.block = philox(self.counter, self.key);
            self.used = 0;
        }
        self.used += 1;
        self.block[self.used - 1]
    }

    /// Uniform in [0, 1): the upper 53 bits over 2^53.
    pub fn unit(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Returns a random unit vector along the first `n` axes; its other entries are 0. For one axis it is ±1. For two
    /// it is uniform on the circle: the angle is drawn. For three it is uniform on the sphere: the last coordinate is
    /// drawn, then the angle about the last axis.
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

    /// Uniform in [low, high).
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

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

    /// Random123 (Salmon et al.), `tests/kat_vectors`, the three lines `philox4x64 10`: counter, key, result.
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
