//! How a policy does over two parameters.

use serde::{Deserialize, Serialize};

use perturb_protocol::proto::{self, Interval};

use crate::means::mean;
use crate::records::{EpisodeRecord, Records};
use crate::sets::Context;

/// The most points along an axis: all environments run together.
pub const MOST_POINTS: usize = 100;

/// What to test.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeatmapOptions {
    /// Names of the two parameters, along x and along y.
    pub parameters: [String; 2],
    /// Points along each axis, 1 … 100.
    pub grid: usize,
    /// Episodes at each point, at least 1.
    pub episodes: u64,
    /// Fixes all randomness.
    pub seed: u64,
    /// Values of other parameters; the rest have those of version D.
    #[serde(default, skip_serializing_if = "Context::is_empty")]
    pub fixed: Context,
}

/// A parameter as an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    /// The parameter.
    pub name: String,
    /// Its unit; "1" if dimensionless.
    pub unit: String,
    /// The lowest value of R and E.
    pub low: f64,
    /// The highest value of R and E.
    pub high: f64,
    /// R, as pairs of low and high.
    pub random: Vec<(f64, f64)>,
    /// E, likewise.
    pub extreme: Vec<(f64, f64)>,
}

/// A policy's figures over two parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct Heatmap {
    /// The environment.
    pub environment: String,
    /// What was tested, e.g. "a2c ff, trained on D with seed 1".
    pub policy: String,
    /// x and y.
    pub axes: [Axis; 2],
    /// G, points along each axis.
    pub grid: usize,
    /// Episodes at each point.
    pub episodes: u64,
    /// `[G, G]` mean undiscounted returns, by y, then x, in ascending order.
    pub returns: Vec<f64>,
    /// `[G, G]` success rates, %.
    pub success: Vec<f64>,
}

impl Axis {
    /// The value of the `index`th of `grid` points, which stand in the middle of equal parts.
    pub fn value(&self, index: usize, grid: usize) -> f64 {
        self.low + (self.high - self.low) * (index as f64 + 0.5) / grid as f64
    }

    /// The axis of a parameter.
    pub fn of(parameter: &proto::Parameter) -> Self {
        let pairs = |distribution: &Option<proto::Distribution>| -> Vec<(f64, f64)> {
            let intervals = distribution.iter().flat_map(|distribution| &distribution.intervals);
            intervals.map(|Interval { low, high }| (*low, *high)).collect()
        };
        let (random, extreme) = (pairs(&parameter.random), pairs(&parameter.extreme));
        let all = || random.iter().chain(&extreme);
        Self {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            low: all().map(|pair| pair.0).fold(f64::INFINITY, f64::min),
            high: all().map(|pair| pair.1).fold(f64::NEG_INFINITY, f64::max),
            random,
            extreme,
        }
    }
}

impl Heatmap {
    /// What the set of a heatmap's recorded test is called.
    pub const SET: &str = "heatmap";

    /// From the recorded episodes of a test over `axes`, whose contexts are the points, by y, then x; `None` if they are
    /// those of something else.
    pub fn of(records: &Records, policy: String, axes: [Axis; 2]) -> Option<Self> {
        let test = records.about.tests.iter().find(|test| test.set.name == Self::SET)?;
        let contexts = test.set.listed();
        let (points, grid) = (contexts.len(), contexts.len().isqrt());
        let fits = |(point, context): (usize, &Context)| {
            let [x, y] = &axes;
            context.get(&x.name) == Some(&x.value(point % grid, grid))
                && context.get(&y.name) == Some(&y.value(point / grid, grid))
        };
        if grid * grid != points || !contexts.iter().enumerate().all(fits) {
            return None;
        }
        let mut by_point: Vec<Vec<&EpisodeRecord>> = vec![Vec::new(); points];
        records.of(Self::SET).for_each(|episode| by_point[episode.environment_index as usize % points].push(episode));
        let means = |of: fn(&EpisodeRecord) -> f64| {
            by_point.iter().map(|episodes| mean(episodes.iter().map(|episode| of(episode)))).collect()
        };
        Some(Self {
            environment: records.about.environment.clone(),
            policy,
            axes,
            grid,
            episodes: by_point.first()?.len() as u64,
            returns: means(|episode| episode.episode_return),
            success: means(|episode| if episode.success { 100.0 } else { 0.0 }),
        })
    }
}

/// The figures as CSV: a line a point.
///
/// # Errors
/// [`csv::Error`], which writing to memory does not give.
pub fn heatmap_csv(heatmap: &Heatmap) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let [x, y] = &heatmap.axes;
    writer.write_record([x.name.as_str(), y.name.as_str(), "mean_return", "success_percent"])?;
    for (slot, (episode_return, success)) in heatmap.returns.iter().zip(&heatmap.success).enumerate() {
        let (column, row) = (slot % heatmap.grid, slot / heatmap.grid);
        let point = [x.value(column, heatmap.grid), y.value(row, heatmap.grid), *episode_return, *success];
        writer.write_record(point.map(|number| number.to_string()))?;
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}
