//! The physical parameters of an environment: their bounds, and the sets of the versions.

use super::{Distribution, Interval, Version};

/// A physical parameter with its bounds and the sets of its versions (the paper, table of parameter ranges).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// Unique within its environment.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
    /// The meaning, in a few words.
    pub description: &'static str,
    /// The value in version D.
    pub default: f64,
    /// The interval of version R.
    pub random: Interval,
    /// The intervals of version E, below and above that of R.
    pub extreme: [Interval; 2],
    /// The physical range. Values outside are refused.
    pub bounds: Interval,
    /// The name in [`EnvironmentSpec::applied`](super::EnvironmentSpec::applied) of the quantity that reads this parameter
    /// back, in the same unit.
    pub applied: &'static str,
    /// Whether values are whole numbers: each whole number in a distribution's intervals is equally likely.
    pub is_integer: bool,
}

impl Parameter {
    /// A parameter with physical bounds, which the quantity of the same name reads back, and whose sets are given by
    /// [`Parameter::versions`].
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

    /// Sets the versions: the value of D, the interval of R, and the interval whose part outside R is E.
    pub const fn versions(mut self, default: f64, random: (f64, f64), around: (f64, f64)) -> Self {
        self.default = default;
        self.random = Interval::new(random.0, random.1);
        self.extreme = [Interval::new(around.0, random.0), Interval::new(random.1, around.1)];
        self
    }

    /// Sets one value for all versions, so that nothing is drawn unless a client gives a distribution.
    pub const fn off(self, default: f64) -> Self {
        self.versions(default, (default, default), (default, default))
    }

    /// Makes the values whole numbers.
    pub const fn integer(mut self) -> Self {
        self.is_integer = true;
        self
    }

    /// Sets the quantity that reads the parameter back.
    pub const fn read_back_by(mut self, applied: &'static str) -> Self {
        self.applied = applied;
        self
    }

    /// Returns the distribution of a version. For R+E, whose trials are drawn from R or from E for all parameters together,
    /// returns the union of both. Intervals without length, as a task's folder may have on one side of R, are left out.
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

    /// Returns the value at the fraction `u` in [0, 1) of a distribution, which was checked against the parameter.
    pub fn draw(&self, distribution: &Distribution, u: f64) -> f64 {
        let whole = if self.is_integer { distribution.whole_number_at(u) } else { None };
        whole.unwrap_or_else(|| distribution.at(u))
    }

    /// Returns the interval from the minimum to the maximum of R and E.
    pub fn whole(&self) -> Interval {
        let [below, above] = self.extreme;
        Interval::new(self.random.low.min(below.low), self.random.high.max(above.high))
    }

    /// Scales a value for observations: -1 … 1 within [`Parameter::whole`], and linearly beyond it. If that interval is a
    /// single value, returns the distance from it.
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
        let one_sided = Parameter::new("x", "1", "", (0.0, 9.0)).versions(1.0, (1.0, 3.0), (1.0, 5.0));
        let above = Distribution::union(&[Interval::new(3.0, 5.0)]).unwrap();
        assert_eq!(one_sided.distribution(Version::E), above);
        let fixed = Parameter::new("x", "1", "", (0.0, 9.0)).versions(1.0, (1.0, 1.0), (1.0, 1.0));
        for version in [Version::D, Version::R, Version::E, Version::RE] {
            assert_eq!(fixed.distribution(version), Distribution::fixed(1.0), "{version:?}");
        }
    }

    #[test]
    fn observed_parameter_is_linear_within_and_beyond_versions() {
        let wider_e = Parameter::new("x", "1", "", (0.0, 100.0)).versions(2.0, (1.0, 3.0), (0.5, 4.5));
        let seen = |p: &Parameter, values: &[f64]| values.iter().map(|&value| p.observed(value)).collect::<Vec<_>>();
        assert_eq!(seen(&wider_e, &[0.5, 2.5, 4.5, 0.0, 8.5]), [-1.0, 0.0, 1.0, -1.25, 3.0]);
        let wider_r = Parameter { random: Interval::new(0.0, 8.0), ..wider_e };
        assert_eq!(seen(&wider_r, &[0.0, 4.0, 8.0]), [-1.0, 0.0, 1.0], "R reaches further than E");
        let single = Parameter::new("x", "1", "", (0.0, 100.0)).versions(2.0, (2.0, 2.0), (2.0, 2.0));
        assert_eq!(seen(&single, &[2.0, 0.5, 3.0]), [0.0, -1.5, 1.0], "nothing is divided by 0");
    }
}
