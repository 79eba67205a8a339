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
}

impl Parameter {
    /// A parameter with physical bounds, which the quantity of the same name reads back, and whose sets are given by
    /// [`Parameter::versions`].
    pub const fn new(name: &'static str, unit: &'static str, description: &'static str, bounds: (f64, f64)) -> Self {
        let (bounds, none) = (Interval::new(bounds.0, bounds.1), Interval::new(0.0, 0.0));
        Self { name, unit, description, default: 0.0, random: none, extreme: [none; 2], bounds, applied: name }
    }

    /// The same with the sets of its versions: the value of D, the interval of R, and the interval that E fills up around
    /// it.
    pub const fn versions(mut self, default: f64, random: (f64, f64), around: (f64, f64)) -> Self {
        self.default = default;
        self.random = Interval::new(random.0, random.1);
        self.extreme = [Interval::new(around.0, random.0), Interval::new(random.1, around.1)];
        self
    }

    /// The same, read back by another quantity.
    pub const fn read_back_by(mut self, applied: &'static str) -> Self {
        self.applied = applied;
        self
    }

    /// The distribution of a version.
    pub fn distribution(&self, version: Version) -> Distribution {
        let intervals: &[Interval] = match version {
            Version::D => return Distribution::fixed(self.default),
            Version::R => &[self.random],
            Version::E => &self.extreme,
        };
        Distribution::union(intervals).expect("the table holds valid sets; a test checks each")
    }
}
