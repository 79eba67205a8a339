//! A parameter that varies along an axis of a heatmap.

use perturb_protocol::proto::{self, Interval};
use serde::{Deserialize, Serialize};

/// An axis of a heatmap: a parameter and the range of its values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// The name of the parameter.
    pub name: String,
    /// The unit; "1" if dimensionless.
    pub unit: String,
    /// The default value of the parameter.
    pub default: f64,
    /// The lowest value that version R (random) or version E (extreme) draws.
    pub low: f64,
    /// The highest value that version R (random) or version E (extreme) draws.
    pub high: f64,
    /// The intervals from which version R (random) draws, as pairs (low, high).
    pub random: Vec<(f64, f64)>,
    /// The intervals from which version E (extreme) draws, as pairs (low, high).
    pub extreme: Vec<(f64, f64)>,
}

impl Axis {
    /// Returns the value of grid point `index`, from 0. The axis is divided into `grid` equal parts, and each point is
    /// in the middle of its part.
    pub fn value(&self, index: usize, grid: usize) -> f64 {
        self.low + (self.high - self.low) * (index as f64 + 0.5) / grid as f64
    }

    /// Returns the axis for a parameter.
    pub fn new(parameter: &proto::Parameter) -> Self {
        let pairs = |distribution: &Option<proto::Distribution>| -> Vec<(f64, f64)> {
            let intervals = distribution.iter().flat_map(|distribution| &distribution.intervals);
            intervals.map(|Interval { low, high }| (*low, *high)).collect()
        };
        let (random, extreme) = (pairs(&parameter.random), pairs(&parameter.extreme));
        let all = || random.iter().chain(&extreme);
        Self {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            default: parameter.default_value,
            low: all().map(|pair| pair.0).fold(f64::INFINITY, f64::min),
            high: all().map(|pair| pair.1).fold(f64::NEG_INFINITY, f64::max),
            random,
            extreme,
        }
    }
}
