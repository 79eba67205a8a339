//! The normal random numbers of the noise at a step. They depend only on the episode and the step, so they can be drawn
//! before the step is requested, while the server waits for the client.

use crate::env::{Draw, DrawPurpose, PhiloxStream};

/// The numbers of one step's noise that were drawn before the step.
pub(super) struct NoiseAhead {
    purpose: DrawPurpose,
    /// The episode and the step of `numbers`. `None` before the first draw.
    address: Option<(Draw, u32)>,
    numbers: Vec<f64>,
}

impl NoiseAhead {
    /// Makes storage for `n` numbers of noise at a step. `purpose` selects the random stream.
    pub(super) fn new(purpose: DrawPurpose, n: usize) -> Self {
        Self { purpose, address: None, numbers: vec![0.0; n] }
    }

    /// Draws the numbers for step number `step` of an episode.
    pub(super) fn draw(&mut self, draw: &Draw, step: u32) {
        let mut stream = PhiloxStream::at_step(draw, self.purpose, step);
        let (blocks, rest) = self.numbers.as_chunks_mut::<4>();
        blocks.iter_mut().for_each(|block| *block = stream.normals());
        rest.iter_mut().for_each(|number| *number = stream.normal());
        self.address = Some((*draw, step));
    }

    /// Returns the numbers for step number `step` of an episode: those drawn ahead, if they are of this step, or else
    /// numbers that are drawn now.
    #[inline]
    pub(super) fn at_step(&self, draw: &Draw, step: u32) -> NoiseNumbers<'_> {
        if self.address == Some((*draw, step)) {
            NoiseNumbers::Ahead(&self.numbers)
        } else {
            NoiseNumbers::Now(PhiloxStream::at_step(draw, self.purpose, step))
        }
    }
}

/// The normal numbers of the noise at one step.
pub(super) enum NoiseNumbers<'a> {
    /// The remaining numbers that were drawn ahead.
    Ahead(&'a [f64]),
    /// The stream from which the numbers are drawn.
    Now(PhiloxStream),
}

impl NoiseNumbers<'_> {
    /// Returns the next `N` ≤ 4 numbers.
    ///
    /// # Panics
    /// If more numbers are requested than the step has.
    #[inline]
    pub(super) fn next<const N: usize>(&mut self) -> [f64; N] {
        match self {
            Self::Ahead(numbers) => {
                let (next, rest) = numbers.split_first_chunk().expect("a step has enough numbers of noise");
                *numbers = rest;
                *next
            }
            Self::Now(stream) => stream.normals(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_drawn_ahead_are_used_at_their_step_only() {
        let draw = Draw { seed: 7, environment_index: 3, episode_index: 2 };
        let mut noise = NoiseAhead::new(DrawPurpose::SensorNoise, 6);
        let now = noise.at_step(&draw, 5).next::<4>();
        noise.draw(&draw, 5);
        let mut ahead = noise.at_step(&draw, 5);
        assert!(matches!(ahead, NoiseNumbers::Ahead(_)));
        assert_eq!(ahead.next::<4>(), now);
        let others = [(Draw { episode_index: 3, ..draw }, 5), (draw, 6)];
        assert!(others.iter().all(|(draw, step)| matches!(noise.at_step(draw, *step), NoiseNumbers::Now(_))));
    }
}
