//! Disturbs actions: delay, repetition (`action_hold`), noise and scale.

use super::{finite, next_offset, noise::NoiseAhead, parameters::DisturbanceValues};
use crate::env::{Action, ActionSpec, Draw, DrawPurpose, Error, PhiloxStream};
use std::mem::replace;

/// Disturbs the actions of one environment on their way to the physics. An action is stored as A numbers: a continuous
/// action as one number per channel, a discrete action as the index of its choice (A = 1).
pub(super) struct ActionPath {
    space: ActionSpec,
    /// The action that acts until the client's first action arrives, `[A]`.
    neutral: Vec<f32>,
    /// A ring buffer of the client's actions that have not reached the physics yet, `[action_delay, A]`.
    delayed: Vec<f32>,
    /// The index in `delayed` of the first number of the oldest action.
    oldest: usize,
    /// The action of the current step before noise and scale, `[A]`. `action_hold` may repeat it in the next step.
    held: Vec<f32>,
    /// The continuous action of the current step after noise and scale, `[A]`, as the physics receive it. Not used for
    /// discrete actions.
    acting: Vec<f32>,
    noise: NoiseAhead,
}

impl ActionPath {
    /// Creates the path for actions of `space`. `neutral` is the environment's action with the least effect, `[A]`.
    pub(super) fn new(space: ActionSpec, neutral: Vec<f32>) -> Self {
        let (held, acting) = (neutral.clone(), neutral.clone());
        let noise = NoiseAhead::new(DrawPurpose::ActionNoise, neutral.len());
        Self { space, neutral, delayed: Vec::new(), oldest: 0, held, acting, noise }
    }

    /// Begins an episode. The neutral action acts until the client's first action arrives.
    pub(super) fn begin(&mut self, values: &DisturbanceValues) {
        self.delayed.clear();
        for _ in 0..values.action_delay {
            self.delayed.extend_from_slice(&self.neutral);
        }
        self.oldest = 0;
        self.held.copy_from_slice(&self.neutral);
    }

    /// Draws the noise on the action of step number `step`, before the client's action is known.
    pub(super) fn draw_ahead(&mut self, values: &DisturbanceValues, draw: &Draw, step: u32) {
        if values.action_noise > 0.0 && matches!(self.space, ActionSpec::Continuous(_)) {
            self.noise.draw(draw, step);
        }
    }

    /// Takes the client's action for step number `step`, counted from 0. Returns the disturbed action for the physics.
    #[inline]
    pub(super) fn apply(
        &mut self,
        values: &DisturbanceValues,
        draw: &Draw,
        step: u32,
        action: Action<'_>,
    ) -> Action<'_> {
        let is_held = values.action_hold > 0.0
            && step > 0
            && PhiloxStream::at_step(draw, DrawPurpose::ActionHold, step).unit() < values.action_hold;
        let oldest = self.oldest;
        if values.action_delay > 0 {
            self.oldest = next_offset(oldest, self.neutral.len(), self.delayed.len());
        }
        // `held` becomes the action that has now passed the delay, unless the step repeats the previous action.
        match (action, self.space) {
            // The index is exact in f32, because there are few choices.
            (Action::Discrete(choice), _) => {
                let arrived = self.delayed.get_mut(oldest).map_or(choice as f32, |place| replace(place, choice as f32));
                if !is_held {
                    self.held[0] = arrived;
                }
                Action::Discrete(self.held[0] as u32)
            }
            (Action::Continuous(action), ActionSpec::Continuous(channels)) => {
                let mut numbers = (values.action_noise > 0.0).then(|| self.noise.at_step(draw, step));
                for (i, (&action, channel)) in action.iter().zip(channels).enumerate() {
                    let arrived = self.delayed.get_mut(oldest + i).map_or(action, |place| replace(place, action));
                    if !is_held {
                        self.held[i] = arrived;
                    }
                    // Noise and scale change only `acting`, so a repeated action gets new noise.
                    let mut acting = self.held[i];
                    if let Some(numbers) = &mut numbers {
                        let [normal] = numbers.next();
                        let noise = values.action_noise * (channel.high - channel.low) * normal;
                        acting = finite(f64::from(acting) + noise);
                    }
                    let scale = values.action_scales[i];
                    if scale != 1.0 {
                        let neutral = f64::from(self.neutral[i]);
                        acting = finite(neutral + scale * (f64::from(acting) - neutral));
                    }
                    self.acting[i] = acting;
                }
                Action::Continuous(&self.acting)
            }
            (Action::Continuous(_), ActionSpec::Discrete(_)) => unreachable!("actions were checked against the space"),
        }
    }

    /// Returns how many numbers [`ActionPath::save`] appends.
    pub(super) fn n_saved(&self, values: &DisturbanceValues) -> usize {
        (1 + values.action_delay) * self.neutral.len()
    }

    /// Appends `held`, then the delayed actions, oldest first.
    pub(super) fn save(&self, out: &mut Vec<f64>) {
        let (newer, older) = self.delayed.split_at(self.oldest);
        out.extend([&self.held[..], older, newer].into_iter().flatten().map(|&number| f64::from(number)));
    }

    /// Loads the numbers that [`ActionPath::save`] appended. Their count must be [`ActionPath::n_saved`].
    ///
    /// # Errors
    /// [`Error::Snapshot`] if a number is not valid in an action. After an error, the state of the path is undefined.
    pub(super) fn load(&mut self, values: &DisturbanceValues, saved: &[f64]) -> Result<(), Error> {
        let is_legal = |&number: &f64| match self.space {
            ActionSpec::Discrete(names) => number.fract() == 0.0 && (0.0..names.len() as f64).contains(&number),
            ActionSpec::Continuous(_) => (number as f32).is_finite(),
        };
        if let Some(number) = saved.iter().find(|number| !is_legal(number)) {
            let reason = format!("its saved actions contain {number}, which is not valid");
            return Err(Error::Snapshot { reason });
        }
        self.begin(values);
        let (held, delayed) = saved.split_at(self.held.len());
        self.held.iter_mut().zip(held).for_each(|(to, from)| *to = *from as f32);
        self.delayed.iter_mut().zip(delayed).for_each(|(to, from)| *to = *from as f32);
        Ok(())
    }
}
