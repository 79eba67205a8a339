//! The paper's protocol: versions, scenarios and metrics.

use std::fmt;

use super::means::geometric_mean;

pub use perturb_protocol::Version;

/// Training on one version and testing on another, e.g. "DR".
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scenario {
    /// Where the policy was trained.
    pub train: Version,
    /// Where it is tested.
    pub test: Version,
}

impl Scenario {
    /// The nine pairs: DD, DR, DE, RD, … EE.
    pub fn all() -> impl Iterator<Item = Scenario> {
        Version::ALL.into_iter().flat_map(|train| Version::ALL.map(|test| Scenario { train, test }))
    }
}

impl fmt::Display for Scenario {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.train, self.test)
    }
}

/// Success rates of the nine scenarios, in percent, by training and testing version.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates(pub [[f64; 3]; 3]);

impl Rates {
    /// The rate of a scenario, %.
    pub fn of(&self, scenario: Scenario) -> f64 {
        self.0[scenario.train as usize][scenario.test as usize]
    }

    /// The paper's three metrics.
    pub fn metrics(&self) -> Metrics {
        use Version::{D, E, R};
        let rate = |train, test| self.of(Scenario { train, test });
        Metrics {
            default: rate(D, D),
            interpolation: rate(R, R),
            extrapolation: geometric_mean(&[rate(D, R), rate(D, E), rate(R, E)]),
        }
    }
}

/// The paper's metrics, %.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Metrics {
    /// DD.
    pub default: f64,
    /// RR.
    pub interpolation: f64,
    /// The geometric mean of DR, DE and RE.
    pub extrapolation: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nine_scenarios_are_named_by_training_and_testing() {
        let names: Vec<String> = Scenario::all().map(|scenario| scenario.to_string()).collect();
        assert_eq!(names, ["DD", "DR", "DE", "RD", "RR", "RE", "ED", "ER", "EE"]);
    }

    #[test]
    fn metrics_take_their_scenarios() {
        // DD, RR and the three of extrapolation are all different, the unused four would spoil any of them.
        let rates = Rates([[90.0, 20.0, 40.0], [-1.0, 70.0, 10.0], [-2.0, -3.0, -4.0]]);
        let metrics = rates.metrics();
        assert_eq!((metrics.default, metrics.interpolation), (90.0, 70.0));
        assert!((metrics.extrapolation - 20.0).abs() < 1e-12, "the third root of 20 · 40 · 10");
    }
}
