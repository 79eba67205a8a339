//! Disturbs observations: delay, noise and dropout.

use super::{
    finite, next_offset,
    noise::{NoiseAhead, NoiseNumbers},
    parameters::DisturbanceValues,
};
use crate::env::{ChannelSpec, Draw, DrawPurpose, Error, PhiloxStream};

/// Disturbs the observations of one environment on their way to the policy. O is the length of an observation.
pub(super) struct SensorPath {
    channels: &'static [ChannelSpec],
    /// A ring buffer of exact observations, `[sensor_delay + 1, O]`: the policy sees the oldest observation now, with
    /// noise and dropout; the newer observations are still delayed.
    exact: Vec<f32>,
    /// The index in `exact` of the first number of the newest observation.
    newest: usize,
    noise: NoiseAhead,
}

impl SensorPath {
    /// Creates the path for observations whose entries are `channels`.
    pub(super) fn new(channels: &'static [ChannelSpec]) -> Self {
        let noise = NoiseAhead::new(DrawPurpose::SensorNoise, channels.len());
        Self { channels, exact: vec![0.0; channels.len()], newest: 0, noise }
    }

    /// Begins an episode. The callback `observe` writes the first exact observation. The policy sees this observation,
    /// with noise and dropout, until the second observation has passed the delay.
    pub(super) fn begin(&mut self, values: &DisturbanceValues, observe: impl FnOnce(&mut [f32])) {
        let width = self.channels.len();
        self.exact.resize((values.sensor_delay + 1) * width, 0.0);
        let (first, others) = self.exact.split_at_mut(width);
        observe(first);
        others.chunks_exact_mut(width.max(1)).for_each(|other| other.copy_from_slice(first));
        self.newest = 0;
    }

    /// Adds the exact observation after a step. The callback `observe` writes this observation.
    #[inline]
    pub(super) fn apply(&mut self, observe: impl FnOnce(&mut [f32])) {
        let width = self.channels.len();
        self.newest = next_offset(self.newest, width, self.exact.len());
        observe(&mut self.exact[self.newest..][..width]);
    }

    /// Draws the noise on the observation after `steps` steps of the episode, before this observation exists.
    pub(super) fn draw_ahead(&mut self, values: &DisturbanceValues, draw: &Draw, steps: u32) {
        if values.sensor_noise > 0.0 {
            self.noise.draw(draw, steps);
        }
    }

    /// Writes the observation that the policy sees after `steps` steps of the episode to `out`, `[O]`: the oldest
    /// observation in the ring buffer, with noise and dropout.
    pub(super) fn observe(&self, values: &DisturbanceValues, draw: &Draw, steps: u32, out: &mut [f32]) {
        let width = self.channels.len();
        let oldest = next_offset(self.newest, width, self.exact.len());
        let exact = &self.exact[oldest..][..width];
        if values.sensor_noise > 0.0 {
            let mut numbers = self.noise.at_step(draw, steps);
            let mut begin = 0;
            while begin < width {
                let (channels, exact, out) = (&self.channels[begin..], &exact[begin..], &mut out[begin..]);
                match width - begin {
                    1 => add_noise::<1>(&mut numbers, values.sensor_noise, channels, exact, out),
                    2 => add_noise::<2>(&mut numbers, values.sensor_noise, channels, exact, out),
                    3 => add_noise::<3>(&mut numbers, values.sensor_noise, channels, exact, out),
                    _ => add_noise::<4>(&mut numbers, values.sensor_noise, channels, exact, out),
                }
                begin += 4;
            }
        } else {
            out.copy_from_slice(exact);
        }
        if values.sensor_dropout > 0.0 {
            let mut stream = PhiloxStream::at_step(draw, DrawPurpose::SensorDropout, steps);
            for (entry, channel) in out.iter_mut().zip(self.channels) {
                let is_lost = stream.unit() < values.sensor_dropout;
                if is_lost && channel.scale > 0.0 {
                    *entry = 0.0_f64.clamp(channel.low, channel.high) as f32;
                }
            }
        }
    }

    /// Returns how many numbers [`SensorPath::save`] appends.
    pub(super) fn n_saved(&self, values: &DisturbanceValues) -> usize {
        values.sensor_delay * self.channels.len()
    }

    /// Appends the exact observations, oldest first, without the newest one.
    pub(super) fn save(&self, out: &mut Vec<f64>) {
        let (newer, older) = self.exact.split_at(self.newest);
        let older = &older[self.channels.len()..];
        out.extend(older.iter().chain(newer).map(|&number| f64::from(number)));
    }

    /// Loads the numbers that [`SensorPath::save`] appended. The count of `saved` must be [`SensorPath::n_saved`].
    /// `save` leaves out the newest exact observation, so the callback `observe` writes this observation.
    ///
    /// # Errors
    /// [`Error::Snapshot`] if a number is not finite as float32. After an error, the state of the path is undefined.
    pub(super) fn load(
        &mut self,
        values: &DisturbanceValues,
        saved: &[f64],
        observe: impl FnOnce(&mut [f32]),
    ) -> Result<(), Error> {
        if let Some(number) = saved.iter().find(|number| !(**number as f32).is_finite()) {
            let reason = format!("its saved observations contain {number}, which is not valid");
            return Err(Error::Snapshot { reason });
        }
        self.exact.resize((values.sensor_delay + 1) * self.channels.len(), 0.0);
        self.newest = saved.len();
        self.exact.iter_mut().zip(saved).for_each(|(to, from)| *to = *from as f32);
        observe(&mut self.exact[self.newest..]);
        Ok(())
    }
}

/// Writes `N` entries of an observation with noise to `out`. `sensor_noise` is the standard deviation as a share of
/// each entry's scale.
#[inline]
fn add_noise<const N: usize>(
    numbers: &mut NoiseNumbers<'_>,
    sensor_noise: f64,
    channels: &[ChannelSpec],
    exact: &[f32],
    out: &mut [f32],
) {
    let (channels, exact, out) = (&channels[..N], &exact[..N], &mut out[..N]);
    let normals = numbers.next::<N>();
    for i in 0..N {
        let ChannelSpec { scale, low, high, .. } = channels[i];
        let noisy = f64::from(exact[i]) + sensor_noise * scale * normals[i];
        // NaN fails both comparisons, and stays. `clamp` would be slower, because it also checks that `low` ≤ `high`.
        let noisy = if noisy < low { low } else { noisy };
        let noisy = if noisy > high { high } else { noisy };
        out[i] = if scale > 0.0 { finite(noisy) } else { exact[i] };
    }
}
