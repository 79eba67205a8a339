//! How a policy does over two parameters.

use serde::{Deserialize, Serialize};

use perturb_protocol::proto::{self, Interval};

use crate::means::mean;
use crate::records::{EpisodeRecord, Records};
use crate::sets::Context;
use crate::table::Table;

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
    /// By its name in the catalogue.
    pub environment: String,
    /// What was tested, e.g. "a2c ff, trained on D with seed 1".
    pub policy: String,
    /// x and y.
    pub axes: [Axis; 2],
    /// G, points along each axis.
    pub grid: usize,
    /// Episodes at each point.
    pub episodes: u64,
    /// `[G, G]`, by y, then x, in ascending order.
    pub points: Vec<HeatmapPoint>,
}

/// A policy's figures where the two parameters have these values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeatmapPoint {
    /// The value of the parameter along x.
    pub x: f64,
    /// The value of the parameter along y.
    pub y: f64,
    /// Undiscounted.
    pub mean_return: f64,
    /// Of the point's episodes.
    pub success_percent: f64,
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
        let [x, y] = &axes;
        let place = |point: usize| (x.value(point % grid, grid), y.value(point / grid, grid));
        let fits = |(point, context): (usize, &Context)| {
            (context.get(&x.name), context.get(&y.name)) == (Some(&place(point).0), Some(&place(point).1))
        };
        if grid * grid != points || !contexts.iter().enumerate().all(fits) {
            return None;
        }
        let mut by_point: Vec<Vec<&EpisodeRecord>> = vec![Vec::new(); points];
        records.of(Self::SET).for_each(|episode| by_point[episode.environment_index as usize % points].push(episode));
        let figures = |(point, episodes): (usize, &Vec<&EpisodeRecord>)| HeatmapPoint {
            x: place(point).0,
            y: place(point).1,
            mean_return: mean(episodes.iter().map(|episode| episode.episode_return)),
            success_percent: mean(episodes.iter().map(|episode| if episode.success { 100.0 } else { 0.0 })),
        };
        Some(Self {
            environment: records.about.environment.clone(),
            policy,
            grid,
            episodes: by_point.first()?.len() as u64,
            points: by_point.iter().enumerate().map(figures).collect(),
            axes,
        })
    }
}

/// A line for each point.
pub fn heatmap_table(heatmap: &Heatmap) -> Table {
    let [x, y] = &heatmap.axes;
    Table::of("", &heatmap.points)
        .number(&x.name, |point| point.x)
        .number(&y.name, |point| point.y)
        .number("mean_return", |point| point.mean_return)
        .number("success_percent", |point| point.success_percent)
        .build()
}
