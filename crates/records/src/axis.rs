//! A parameter along an axis of a heatmap.

use perturb_protocol::proto::{self, Interval};
use serde::{Deserialize, Serialize};

/// A parameter as an axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// The parameter.
    pub name: String,
    /// The unit; "1" if dimensionless.
    pub unit: String,
    /// The value in D.
    pub default: f64,
    /// The lowest value of R and E.
    pub low: f64,
    /// The highest value of R and E.
    pub high: f64,
    /// R, as pairs of low and high.
    pub random: Vec<(f64, f64)>,
    /// E, as pairs of low and high.
    pub extreme: Vec<(f64, f64)>,
}

impl Axis {
    /// The value of the `index`th of `grid` points, which stand in the middle of equal parts.
    pub fn value(&self, index: usize, grid: usize) -> f64 {
        self.low + (self.high - self.low) * (index as f64 + 0.5) / grid as f64
    }

    /// The axis of a parameter.
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
