//! The physical parameters of an environment: their bounds, and the values that each version draws.

use super::{Distribution, Interval, Version};

/// A physical parameter, with its bounds and the values that versions D, R and E draw. Source: the paper, table of
/// parameter ranges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterSpec {
    /// The name, unique within the environment.
    pub name: &'static str,
    /// The SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
    /// The meaning, in a few words.
    pub description: &'static str,
    /// The value in version D.
    pub default: f64,
    /// The interval of version R.
    pub random: Interval,
    /// The intervals of version E: one below and one above the interval of R.
    pub extreme: [Interval; 2],
    /// The physical range. Requests for values outside are refused.
    pub bounds: Interval,
    /// The name of the quantity in [`EnvironmentSpec::applied`](super::EnvironmentSpec::applied) that reads this
    /// parameter back from the physics, in the same unit.
    pub applied: &'static str,
    /// Whether values are whole numbers. Then each whole number in a distribution's intervals is equally likely.
    pub is_integer: bool,
}

impl ParameterSpec {
    /// Creates a parameter with the physical range `bounds`. The applied quantity of the same name reads it back. Set
    /// the values of the versions by [`ParameterSpec::versions`] or [`ParameterSpec::off`].
    pub const fn new(name: &'static str, unit: &'static str, description: &'static str, bounds: (f64, f64)) -> Self {
        let (bounds, none) = (Interval::new(bounds.0, bounds.1), Interval::new(0.0, 0.0));
        Self {
            name,
            unit,
            description,
            default: 0.0,
            random: none,
            extreme: [none; 2],
            bounds,
            applied: name,
            is_integer: false,
        }
    }

    /// Sets the values of the versions: D has the value `default`, R the interval `random`, and E the two parts of the
    /// interval `around` that are outside R.
    pub const fn versions(mut self, default: f64, random: (f64, f64), around: (f64, f64)) -> Self {
        self.default = default;
        self.random = Interval::new(random.0, random.1);
        self.extreme = [Interval::new(around.0, random.0), Interval::new(random.1, around.1)];
        self
    }

    /// Sets the same fixed value for all versions, so that the parameter varies only if a client requests a
    /// distribution.
    pub const fn off(self, default: f64) -> Self {
        self.versions(default, (default, default), (default, default))
    }

    /// Restricts the values to whole numbers.
    pub const fn integer(mut self) -> Self {
        self.is_integer = true;
        self
    }

    /// Sets the name of the quantity that reads the parameter back, see [`ParameterSpec::applied`].
    pub const fn read_back_by(mut self, applied: &'static str) -> Self {
        self.applied = applied;
        self
    }

    /// Returns the distribution of a version. For R+E, this is the union of the intervals of R and E, although a trial
    /// draws all parameters from R or all from E. Intervals of length 0 are left out: in a task folder, E may extend to
    /// only one side of R. If no interval is left, the distribution is the default value.
    pub fn distribution(&self, version: Version) -> Distribution {
        let [below, above] = self.extreme;
        let intervals: &[Interval] = match version {
            Version::D => return Distribution::fixed(self.default),
            Version::R => &[self.random],
            Version::E => &self.extreme,
            Version::RE => &[below, self.random, above],
        };
        let intervals: Vec<Interval> = intervals.iter().copied().filter(|it| it.low < it.high).collect();
        if intervals.is_empty() {
            return Distribution::fixed(self.default);
        }
        Distribution::union(&intervals).expect("the table holds valid sets; a test checks each")
    }

    /// Draws a value from `distribution` by the random number `u`, uniform in [0, 1). The caller must have checked the
    /// distribution by [`check_distribution`](super::check_distribution).
    pub fn draw(&self, distribution: &Distribution, u: f64) -> f64 {
        let whole = if self.is_integer { distribution.whole_number_at(u) } else { None };
        whole.unwrap_or_else(|| distribution.at(u))
    }

    /// Returns the smallest interval that contains the intervals of R and E.
    pub fn whole(&self) -> Interval {
        let [below, above] = self.extreme;
        Interval::new(self.random.low.min(below.low), self.random.high.max(above.high))
    }

    /// Scales a value for observations. The scaling is linear: the ends of [`ParameterSpec::whole`] become -1 and 1. If
    /// that interval is a single value, returns the difference from it.
    pub fn observed(&self, value: f64) -> f32 {
        let Interval { low, high } = self.whole();
        let distance = value - low;
        (if high > low { 2.0 * distance / (high - low) - 1.0 } else { distance }) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_without_length_are_left_out() {
        let one_sided = ParameterSpec::new("x", "1", "", (0.0, 9.0)).versions(1.0, (1.0, 3.0), (1.0, 5.0));
        let above = Distribution::union(&[Interval::new(3.0, 5.0)]).unwrap();
        assert_eq!(one_sided.distribution(Version::E), above);
        let fixed = ParameterSpec::new("x", "1", "", (0.0, 9.0)).versions(1.0, (1.0, 1.0), (1.0, 1.0));
        for version in [Version::D, Version::R, Version::E, Version::RE] {
            assert_eq!(fixed.distribution(version), Distribution::fixed(1.0), "{version:?}");
        }
    }

    #[test]
    fn observed_parameter_is_linear_within_and_beyond_versions() {
        let wider_e = ParameterSpec::new("x", "1", "", (0.0, 100.0)).versions(2.0, (1.0, 3.0), (0.5, 4.5));
        let seen =
            |p: &ParameterSpec, values: &[f64]| values.iter().map(|&value| p.observed(value)).collect::<Vec<_>>();
        assert_eq!(seen(&wider_e, &[0.5, 2.5, 4.5, 0.0, 8.5]), [-1.0, 0.0, 1.0, -1.25, 3.0]);
        let wider_r = ParameterSpec { random: Interval::new(0.0, 8.0), ..wider_e };
        assert_eq!(seen(&wider_r, &[0.0, 4.0, 8.0]), [-1.0, 0.0, 1.0], "R reaches further than E");
        let single = ParameterSpec::new("x", "1", "", (0.0, 100.0)).versions(2.0, (2.0, 2.0), (2.0, 2.0));
        assert_eq!(seen(&single, &[2.0, 0.5, 3.0]), [0.0, -1.5, 1.0], "nothing is divided by 0");
    }
}
