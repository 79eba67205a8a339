//! The evaluation protocol of Packer et al. (2018), "the paper": versions, scenarios and metrics.

use std::fmt;

use serde::Deserialize;

use crate::statistics::geometric_mean;

use perturb_protocol::Version;

/// Returns the paper's versions D (deterministic), R (random) and E (extreme), and every other version for which
/// `is_there` returns true.
pub fn versions(is_there: impl Fn(Version) -> bool) -> Vec<Version> {
    Version::KNOWN.into_iter().filter(|version| Version::ALL.contains(version) || is_there(*version)).collect()
}

/// The parameter distribution on which a policy was trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TrainedOn<'a> {
    /// A version: D (deterministic), R (random), E (extreme) or R+E.
    Version(Version),
    /// A parameter set of the experiment file, by its name.
    Set(&'a str),
    /// An unknown distribution, or one that is neither a version nor a set. It occurs only for policies that were not
    /// trained by the experiment.
    Unknown,
}

/// The display name of an unknown distribution.
const UNKNOWN: &str = "unknown";

impl TrainedOn<'_> {
    /// Returns a name that is suitable for file names.
    pub fn file_name(&self) -> &str {
        match self {
            TrainedOn::Version(version) => version.file_name(),
            TrainedOn::Set(name) => name,
            TrainedOn::Unknown => UNKNOWN,
        }
    }
}

impl std::fmt::Display for TrainedOn<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            TrainedOn::Version(version) => version.fmt(f),
            TrainedOn::Set(name) => name.fmt(f),
            TrainedOn::Unknown => UNKNOWN.fmt(f),
        }
    }
}

/// A pair of a training version and a testing version. The scenario "DR", for example, is trained on version D
/// (deterministic) and tested on version R (random).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Scenario {
    /// The version of the training.
    pub train: Version,
    /// The version of the test.
    pub test: Version,
}

impl Scenario {
    /// Returns the nine scenarios of the paper: DD, DR, DE, RD, …, EE.
    pub fn all() -> impl Iterator<Item = Scenario> {
        Version::ALL.into_iter().flat_map(|train| Version::ALL.map(|test| Scenario { train, test }))
    }
}

impl fmt::Display for Scenario {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.train, self.test)
    }
}

/// A metric of generalisation from the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// The success rate of policies trained on D and tested on D.
    Default,
    /// The success rate of policies trained on R and tested on R.
    Interpolation,
    /// The geometric mean of the success rates of scenarios DR, DE and RE.
    Extrapolation,
}

impl Metric {
    /// All metrics, in the paper's order.
    pub const ALL: [Metric; 3] = [Metric::Default, Metric::Interpolation, Metric::Extrapolation];

    /// The scenarios of the metric Extrapolation, which is the geometric mean of their success rates.
    pub const EXTRAPOLATION: [Scenario; 3] = [
        Scenario { train: Version::D, test: Version::R },
        Scenario { train: Version::D, test: Version::E },
        Scenario { train: Version::R, test: Version::E },
    ];

    /// Computes the metric from the success rates of scenarios. Returns `None` if a rate that it needs is missing.
    pub fn value(self, rate_of: impl Fn(Scenario) -> Option<f64>) -> Option<f64> {
        use Version::{D, R};
        let rate = |train, test| rate_of(Scenario { train, test });
        match self {
            Metric::Default => rate(D, D),
            Metric::Interpolation => rate(R, R),
            Metric::Extrapolation => {
                let rates: Option<Vec<f64>> = Self::EXTRAPOLATION.into_iter().map(&rate_of).collect();
                Some(geometric_mean(&rates?))
            }
        }
    }
}

impl fmt::Display for Metric {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
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
        let rate = |scenario: Scenario| match scenario.to_string().as_str() {
            "DD" => Some(90.0),
            "RR" => Some(70.0),
            "DR" => Some(20.0),
            "DE" => Some(40.0),
            "RE" => Some(10.0),
            _ => None,
        };
        assert_eq!((Metric::Default.value(rate), Metric::Interpolation.value(rate)), (Some(90.0), Some(70.0)));
        let extrapolation = Metric::Extrapolation.value(rate).unwrap();
        assert!((extrapolation - 20.0).abs() < 1e-12, "the third root of 20 · 40 · 10");
        for needed in ["DR", "DE", "RE"] {
            assert_eq!(Metric::Extrapolation.value(|s| rate(s).filter(|_| s.to_string() != needed)), None, "{needed}");
        }
    }
}
