//! The physical parameters of an environment: what can be changed, within which bounds, and the sets of its versions.

use super::{Distribution, Interval, Version};

/// A physical parameter with its bounds and the sets of its versions (the paper, table of parameter ranges).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// Unique within its environment.
    pub name: &'static str,
    /// SI unit, `"1"` if dimensionless.
    pub unit: &'static str,
    /// What it is.
    pub description: &'static str,
    /// Version D.
    pub default: f64,
    /// Version R.
    pub random: Interval,
    /// Version E.
    pub extreme: [Interval; 2],
    /// The physical range: nothing outside is accepted.
    pub bounds: Interval,
    /// The quantity of [`EnvironmentSpec::applied`](super::EnvironmentSpec::applied) that reads it back, in the same unit.
    pub applied: &'static str,
    /// Its values are whole numbers: of a distribution's intervals the whole numbers in them, each as likely.
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

    /// The same with the sets of its versions: the value of D, the interval of R, and the interval that E fills up around
    /// it.
    pub const fn versions(mut self, default: f64, random: (f64, f64), around: (f64, f64)) -> Self {
        self.default = default;
        self.random = Interval::new(random.0, random.1);
        self.extreme = [Interval::new(around.0, random.0), Interval::new(random.1, around.1)];
        self
    }

    /// The same with a single value in all versions: nothing is drawn unless a client says so.
    pub const fn off(self, default: f64) -> Self {
        self.versions(default, (default, default), (default, default))
    }

    /// The same with whole numbers as values.
    pub const fn integer(mut self) -> Self {
        self.is_integer = true;
        self
    }

    /// The same, read back by another quantity.
    pub const fn read_back_by(mut self, applied: &'static str) -> Self {
        self.applied = applied;
        self
    }

    /// The distribution of a version; of R+E, whose trials are of one of both for all parameters, the values that it
    /// may have. Intervals without length, as a task's folder may have on one side of R, are left out.
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

    /// The value at the fraction `u` in [0, 1) of a distribution that was checked against the parameter.
    pub fn draw(&self, distribution: &Distribution, u: f64) -> f64 {
        let whole = if self.is_integer { distribution.whole_number_at(u) } else { None };
        whole.unwrap_or_else(|| distribution.at(u))
    }

    /// From the least to the greatest value that R and E have.
    pub fn whole(&self) -> Interval {
        let [below, above] = self.extreme;
        Interval::new(self.random.low.min(below.low), self.random.high.max(above.high))
    }

    /// A value as it is observed: -1 … 1 within [`Parameter::whole`], and linearly beyond it. Where that is a single
    /// value, the distance from it.
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
    fn a_parameter_is_observed_on_the_whole_range_of_the_versions_and_beyond_it() {
        let wider_e = Parameter::new("x", "1", "", (0.0, 100.0)).versions(2.0, (1.0, 3.0), (0.5, 4.5));
        let seen = |p: &Parameter, values: &[f64]| values.iter().map(|&value| p.observed(value)).collect::<Vec<_>>();
        assert_eq!(seen(&wider_e, &[0.5, 2.5, 4.5, 0.0, 8.5]), [-1.0, 0.0, 1.0, -1.25, 3.0]);
        let wider_r = Parameter { random: Interval::new(0.0, 8.0), ..wider_e };
        assert_eq!(seen(&wider_r, &[0.0, 4.0, 8.0]), [-1.0, 0.0, 1.0], "R reaches further than E");
        let single = Parameter::new("x", "1", "", (0.0, 100.0)).versions(2.0, (2.0, 2.0), (2.0, 2.0));
        assert_eq!(seen(&single, &[2.0, 0.5, 3.0]), [0.0, -1.5, 1.0], "nothing is divided by 0");
    }
}
